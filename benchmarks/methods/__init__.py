"""Methods of others that benchmarks compare this project with, written anew from their papers or run as packages."""
