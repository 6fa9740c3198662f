"""The app in the browser: a local page on which a clip is chosen, restored, tuned and saved."""
