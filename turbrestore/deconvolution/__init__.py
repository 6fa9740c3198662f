"""Deconvolution by nonlocal TV, TV, Wiener and Tikhonov regularisation (paper 3, section 5)."""
