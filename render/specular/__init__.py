"""Find light that smooth surfaces send back in one exact direction, by the image method."""
