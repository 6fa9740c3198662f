"""The page of the app: one view for each of its steps.  A view knows the state of its tab, but not the page."""
