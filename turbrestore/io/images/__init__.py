"""Still images, animations and stacks of images, one module a family of formats."""
