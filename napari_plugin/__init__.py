"""turbrestore in napari: clips as layers, and a widget that restores one."""
