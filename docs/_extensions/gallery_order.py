"""Order of the examples in the galleries."""

_ORDER = (
    *("one_dark_view", "bayer", "photographs", "measured_poses", "occlusion"),
    *("penalty_weight", "uncertainty", "surface", "sure_depths", "gain", "noise_maps"),
    *("own_prior", "own_penalty", "lsmr", "pyproximal", "deepinv", "cil_pdhg"),
    *("even_wall", "repeated_pattern", "glass", "mirror", "wrong_poses"),
)


class ReadingOrder:
    """Key by which sphinx-gallery sorts the files of a gallery."""

    def __init__(self, folder: str) -> None:
        self.folder = folder

    def __call__(self, file: str) -> int:
        """Return the place of a file."""
        return _ORDER.index(file.removesuffix(".py").removeprefix("plot_"))
