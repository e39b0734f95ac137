"""What the camera is: its noise, its lens, its poses, and the homographies of a plane."""
