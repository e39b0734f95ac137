"""How the network that improves planes is trained: pictures, pairs, training, export. No part of the product."""
