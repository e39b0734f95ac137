"""Sums of the frames of each node: of the whole rounds over the grid, and of the newest round."""

from collections.abc import Sequence

import numpy as np

from faintfield.recon.likelihood.images import ElementalImages, Image


class ViewSums:
    """Sums of the frames of each node, one after another in memory, which solvers read as they are.

    Those of the `views` that have all of their frames come first; sums of the others follow, in the order of `_order`.
    There is one image per node, however many frames are missing, and `np.empty` takes its memory when it is used.
    """

    def __init__(self, shape: tuple[int, int], nodes: int, frames_per_view: int) -> None:
        self._electrons = np.empty((nodes, *shape), np.float32)
        self._valid = np.empty((nodes, *shape), bool)
        self._frames_per_view = frames_per_view
        self._order: list[int] = []
        self._counts: dict[int, int] = {}
        self._complete = 0

    @property
    def views(self) -> tuple[int, ...]:
        """Views that have all of their frames."""
        return tuple(self._order[: self._complete])

    def __len__(self) -> int:
        return len(self._order)

    def add(self, view: int, electrons: Image, valid: Image | None, frames: int = 1) -> None:
        """Add an image (row, column), the sum of some frames, to its node."""
        if view not in self._counts:
            place = len(self._order)
            self._order.append(view)
            self._counts[view], self._electrons[place], self._valid[place] = 0, 0, True
        place = self._order.index(view)
        self._counts[view] += frames
        self._electrons[place] += electrons
        if valid is not None:
            self._valid[place] &= valid
        if self._counts[view] == self._frames_per_view:
            self._swap(place, self._complete)
            self._complete += 1

    def drop(self, view: int) -> None:
        """Forget a node."""
        if self._counts.pop(view, None) is None:
            return
        place = self._order.index(view)
        if place < self._complete:
            self._complete -= 1
            self._swap(place, self._complete)
            place = self._complete
        self._swap(place, len(self._order) - 1)
        self._order.pop()

    def expect(self, frames_per_view: int) -> None:
        """Change the number of frames that a view has."""
        self._frames_per_view, self._complete = frames_per_view, 0
        for place in range(len(self._order)):
            if self._counts[self._order[place]] == frames_per_view:
                self._swap(place, self._complete)
                self._complete += 1

    def move_to(self, sums: "ViewSums") -> None:
        """Add all nodes to other sums, and forget them."""
        for place, view in enumerate(self._order):
            sums.add(view, self._electrons[place], self._valid[place], self._counts[view])
        self._order, self._counts, self._complete = [], {}, 0

    def images(self, background_e: float | Image, read_variance_e2: float | Image) -> ElementalImages:
        """Return the images in the order of `views`, given what all of them share."""
        valid = self._valid[: self._complete]
        electrons = self._electrons[: self._complete]
        return ElementalImages(electrons, background_e, read_variance_e2, None if valid.all() else valid)

    def _swap(self, first: int, second: int) -> None:
        if first == second:
            return
        for values in (self._electrons, self._valid):
            values[[first, second]] = values[[second, first]]
        self._order[first], self._order[second] = self._order[second], self._order[first]


class RoundSums:
    """Sums of the earlier rounds together, and of the newest, of so many `frames` per view in each planned round.

    All views of a likelihood share an exposure. Within the first round it is that round; later it is the earlier
    rounds. The newest is one of them when a frame of a later round comes, or all nodes have its frames. Frames of
    earlier rounds may come late, and views that lack some are left out until then.
    """

    def __init__(self, shape: tuple[int, int], nodes: int, frames: Sequence[int]) -> None:
        self._frames, self._nodes, self._number = frames, nodes, 0
        self._newest = ViewSums(shape, nodes, frames[0])
        # Of a single round there is never a newer one
        self._earlier = ViewSums(shape, nodes if len(frames) > 1 else 0, 0)

    @property
    def rounds(self) -> int:
        """Number of rounds in `shared`."""
        return max(self._number, 1)

    @property
    def shared(self) -> ViewSums:
        """Sums that a likelihood can take."""
        return self._earlier if self._number else self._newest

    def holds(self, number: int) -> ViewSums:
        """Return the sums that hold a round that has begun."""
        return self._newest if number == self._number else self._earlier

    def add(self, view: int, number: int, images: ElementalImages) -> None:
        """Add a frame of a round to its node."""
        if number > self._number:
            self._begin(number)
        self.holds(number).add(view, images.electrons[0], None if images.valid is None else images.valid[0])
        if len(self._newest.views) == self._nodes:
            self._begin(self._number + 1)

    def drop(self, view: int, number: int) -> None:
        """Forget a node in the sums that hold a round; when all are forgotten, the first round begins again."""
        self.holds(number).drop(view)
        if self._number and not (len(self._earlier) or len(self._newest)):
            self._earlier, self._newest, self._number = self._newest, self._earlier, 0
            self._newest.expect(self._frames[0])

    def _begin(self, number: int) -> None:
        """Begin a newer round: the newest is an earlier one from now on."""
        if self._number == 0:  # there is nothing to add it to
            self._earlier, self._newest = self._newest, self._earlier
        else:
            self._newest.move_to(self._earlier)
        self._number = number
        self._earlier.expect(sum(self._frames[:number]))
        self._newest.expect(sum(self._frames[number : number + 1]))
