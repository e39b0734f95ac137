"""What a pixel's number says of its light: elemental images, pixel models, likelihoods."""
