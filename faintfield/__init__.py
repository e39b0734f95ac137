"""See in the dark: photon-starved integral imaging, calibrated and reconstructed in 3D."""
