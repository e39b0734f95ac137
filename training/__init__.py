"""Training of the network that improves planes: pictures, pairs, training, export. No part of the product."""
