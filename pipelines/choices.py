"""The words that options may be, apart from the code that acts on them: help is shown without loading that."""

from typing import Literal

type Method = Literal["pmlem", "backprojection", "mlem", "pmlem-osl", "joint", "occlusion"]
type PriorName = Literal["tv", "patches", "learned", "auto"]
type SceneKind = Literal["dark_scene", "bright"]
type FigureNumber = Literal[2, 3, 4]
type LensName = Literal["opencv5", "opencv8", "opencv4", "pinhole"]
type PaperName = Literal["A4", "A3", "A2", "letter"]
