"""The depths of a scene, found by comparing its views: autofocus, depth maps."""
