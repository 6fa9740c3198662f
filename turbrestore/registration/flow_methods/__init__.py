"""The methods of optical flow between two images, and the step that refines the flow of any of them."""
