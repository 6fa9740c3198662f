"""Name the folders of wheels in the settings of pip, which uv does not read, as uv expects them."""

import ast
import subprocess
import sys


def find_links() -> str:
    """Value for the variable UV_FIND_LINKS; empty where the settings name no folder."""
    words = [sys.executable, "-m", "pip", "config", "list"]
    lines = subprocess.run(words, check=True, capture_output=True, text=True).stdout.splitlines()
    values = [value for name, _, value in (line.partition("=") for line in lines) if name.endswith(".find-links")]
    # One value may have several folders, and the environment may repeat those of a file.
    return ",".join(dict.fromkeys(folder for value in values for folder in ast.literal_eval(value).split()))


if __name__ == "__main__":
    print(find_links())
