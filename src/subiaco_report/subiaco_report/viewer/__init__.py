"""The 3D viewer: both labelled clouds as octrees, and the page that shows them in a browser."""
