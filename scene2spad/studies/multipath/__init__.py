"""Compare networks with the filter where light takes several paths."""
