"""Video to video: every frame steadied, fused with its neighbours and deblurred, while what moves keeps moving."""
