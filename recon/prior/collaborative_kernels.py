# mypy: disable-error-code="no-untyped-def, no-untyped-call"
"""Groups of alike patches, found and filtered together, compiled.

The patches of a group are kept as an array (row, column, member) of the patch, flat. All loops run along the members or
over whole rows of the patch, so they are vectorised whatever the size of the patches.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.numba_tools import advanced, compiled, index, pointer

# Variance in squared electrons below which a picture counts as free of noise.
_LEAST_VARIANCE = 1e-20

# Share of the noise that the weight of a group assumes to be left at least.
_LEAST_LEFT = 1e-3


class Transform(NamedTuple):
    """Orthonormal cosines (k, i) and (i, k), variances (k, l) of the coefficients of noise, and weights of the samples.

    The noise is a patch of variance one; the window (row, column) are the weights of the samples of a patch.
    """

    cosines: NDArray[np.float32]
    transposed: NDArray[np.float32]
    variances: NDArray[np.float32]
    window: NDArray[np.float32]


@compiled
def filter_rows(picture, pilot, guide, variance, rows, columns, search, transform, above, below):
    """Filter the groups of all reference patches whose first samples lie in `rows` x `columns`.

    Parameters
    ----------
    picture, pilot, guide, variance : float32 array (row, column)
        y, u, a picture l in which patches are compared, and the variance of y. A patch with NaN in l has no group.
    rows, columns : int array
        First row and column of the reference patches.
    search : (int, int, float)
        Largest distance of a member from its reference, along rows and columns, largest number of members, and the
        least magnitude of the coefficients that the second filter keeps, in standard deviations of their noise.
    above, below : float32 array (filter, row, column)
        Sums to which the filtered patches times their weights, and the weights, are added. The first filter is
        Wiener's; the second, if there is one, keeps large coefficients.
    """
    radius, members, threshold = search
    size = transform.window.shape[0]
    distances = np.empty((columns.size, members), np.float32)
    places = np.empty((columns.size, members, 2), np.int32)
    counts = np.empty(columns.size, np.intp)
    patches = np.empty((4, size * size * members), np.float32)
    for row in rows:
        _find_alike(guide, row, columns, size, radius, distances, places, counts)
        for k in range(columns.size):
            count = 1
            while 2 * count <= counts[k]:
                count *= 2
            if counts[k] > 0:
                _filter_group(picture, pilot, variance, places[k, :count], threshold, transform, patches, above, below)


@compiled
def _outwards(step):
    """Return 0, 1, −1, 2, −2 … for 0, 1, 2, 3, 4 …: nearer patches are more often alike, and found first."""
    return (step + 1) // 2 if step % 2 else -(step // 2)


@compiled
def _find_alike(guide, row, columns, size, radius, distances, places, counts):
    """Find the patches nearest to each reference patch of a row, by squared distance, nearest first."""
    height, width = guide.shape
    squares = np.empty(width, np.float32)
    counts[:] = 0
    distances[:] = np.inf
    for vertical in range(2 * radius + 1):
        other = row + _outwards(vertical)
        if other < 0 or other > height - size:
            continue
        for horizontal in range(2 * radius + 1):
            shift = _outwards(horizontal)
            start, stop = max(0, -shift), min(width, width - shift)
            _sum_squares(guide, row, other, shift, start, stop, size, squares)
            for k in range(columns.size):
                column = columns[k]
                if column >= start and column + size <= stop:
                    distance = np.float32(0)
                    for j in range(index(size)):
                        distance += squares[index(column) + j]
                    if distance < distances[k, -1]:  # never for NaN
                        _insert(distance, other, column + shift, distances, places, counts, k)


@compiled
def _sum_squares(guide, row, other, shift, start, stop, size, squares):
    """Set `squares` from `start` to `stop` to the sums over `size` rows of `(l[row, x] − l[other, x + shift])²`."""
    plane, width = pointer(guide), guide.shape[1]
    total = advanced(pointer(squares), start)
    count = index(stop - start)
    for i in range(0, size, 4):
        a = advanced(plane, (row + i) * width + start)
        b = advanced(plane, (other + i) * width + start + shift)
        for x in range(count):
            sum_of_four = total[x] if i > 0 else np.float32(0)
            for r in range(4):
                difference = a[x + index(r * width)] - b[x + index(r * width)]
                sum_of_four += difference * difference
            total[x] = sum_of_four


@compiled
def _insert(distance, row, column, distances, places, counts, k):
    """Insert a patch into the list of those nearest to reference `k`, sorted by distance."""
    at = distances.shape[1] - 1
    counts[k] = min(counts[k] + 1, at + 1)
    while at > 0 and distances[k, at - 1] > distance:
        distances[k, at] = distances[k, at - 1]
        places[k, at, 0], places[k, at, 1] = places[k, at - 1, 0], places[k, at - 1, 1]
        at -= 1
    distances[k, at] = distance
    places[k, at, 0], places[k, at, 1] = row, column


@compiled
def _filter_group(picture, pilot, variance, places, threshold, transform, patches, above, below):
    """Filter the patches of a group by each filter, and add them to its sums."""
    size, count = transform.window.shape[0], places.shape[0]
    y, u, scratch = patches[0], patches[1], patches[2]
    half = size // 2
    level = np.float32(0)
    for m in range(count):
        level += variance[places[m, 0] + half, places[m, 1] + half]
    level = max(level / np.float32(count), np.float32(_LEAST_VARIANCE))
    _read(picture, places, size, y)
    _read(pilot, places, size, u)
    for group in (y, u):
        _cosine_transform(group, scratch, transform.cosines, count)
        _haar(group, size * size, count, False)
    if above.shape[0] > 1:
        kept, length = patches[3], size * size * count
        for k in range(length):  # not `kept[:length] = y[:length]`, which takes seconds to compile
            kept[k] = y[k]
        left = _keep_large(kept, level, threshold, transform, count)
        _add_inverse(kept, scratch, places, transform, level, left, above[1], below[1])
    left = _shrink(y, u, level, transform, count)
    _add_inverse(y, scratch, places, transform, level, left, above[0], below[0])


@compiled
def _shrink(y, u, level, transform, count):
    """Multiply the coefficients of a group by `U²/(U² + v c)`; return the sum of the variances that are left."""
    size = index(transform.window.shape[0])
    left = np.float32(0)
    for k in range(size * size):
        noise = level * transform.variances[k // size, k % size]
        first = k * index(count)
        kept = np.float32(0)
        for m in range(index(count)):
            power = u[first + m] * u[first + m]
            gain = power / (power + noise)
            y[first + m] *= gain
            kept += gain * gain
        left += kept * noise
    return left


@compiled
def _keep_large(y, level, threshold, transform, count):
    """Set the coefficients of a group to zero that may be noise, but never its mean; return the variances left."""
    size = index(transform.window.shape[0])
    left = np.float32(0)
    for k in range(size * size):
        noise = level * transform.variances[k // size, k % size]
        first = k * index(count)
        least = threshold * threshold * noise
        for m in range(index(count)):
            if y[first + m] * y[first + m] > least or k + m == index(0):
                left += noise
            else:
                y[first + m] = np.float32(0)
    return left


@compiled
def _add_inverse(group, scratch, places, transform, level, left, above, below):
    """Transform a group back, and add its patches with the weight that their variance gives them."""
    size, count = transform.window.shape[0], places.shape[0]
    _haar(group, size * size, count, True)
    _cosine_transform(group, scratch, transform.transposed, count)
    weight = np.float32(1) / (left / np.float32(count * size * size) + np.float32(_LEAST_LEFT) * level)
    _add(group, places, size, transform.window, weight, above, below)


@compiled
def _read(plane, places, size, group):
    """Copy the patches at `places` to a group, each member to the slot with its bits in reverse order.

    Then the halves of the group, `m` and `m + count/2`, are neighbours in the order of their distances.
    """
    count = index(places.shape[0])
    for m in range(count):
        row, column = places[m, 0], places[m, 1]
        slot = _reversed_bits(m, count)
        for i in range(size):
            for j in range(size):
                group[index(i * size + j) * count + slot] = plane[row + i, column + j]


@compiled
def _add(group, places, size, window, weight, above, below):
    """Add the patches of a group times their weights, and the weights, to the sums."""
    count = index(places.shape[0])
    for m in range(count):
        row, column = places[m, 0], places[m, 1]
        slot = _reversed_bits(m, count)
        for i in range(size):
            for j in range(size):
                share = weight * window[i, j]
                above[row + i, column + j] += share * group[index(i * size + j) * count + slot]
                below[row + i, column + j] += share


@compiled
def _reversed_bits(number, count):
    """Return a number below `count`, a power of two, with its bits in reverse order."""
    result, bit = index(0), index(1)
    while bit < count:
        result = index(2) * result + number % index(2)
        number, bit = number // index(2), bit * index(2)
    return result


@compiled
def _cosine_transform(group, scratch, cosines, count):
    """Set a group to `Σᵢⱼ C[k, i] C[l, j] x[i, j]` of each patch."""
    size = cosines.shape[0]
    _multiply(cosines, group, scratch, index(size * count), index(0), index(0))
    for k in range(size):
        _multiply(cosines, scratch, group, index(count), index(k * size * count), index(k * size * count))


@compiled
def _multiply(matrix, source, target, length, read_from, write_to):
    """Set rows of `length` numbers of the target to `Σᵢ C[k, i] x[i]`, with x the rows of the source."""
    size = matrix.shape[0]
    for k in range(size):
        out = write_to + index(k) * length
        for t in range(length):
            target[out + t] = np.float32(0)
        for i in range(0, size, 4):
            a, b, c, d = matrix[k, i], matrix[k, i + 1], matrix[k, i + 2], matrix[k, i + 3]
            at = read_from + index(i) * length
            for t in range(length):
                target[out + t] += (
                    a * source[at + t]
                    + b * source[at + length + t]
                    + c * source[at + index(2) * length + t]
                    + d * source[at + index(3) * length + t]
                )


@compiled
def _haar(group, coefficients, count, back):
    """Transform each coefficient along the members, or back: butterflies of halves, which invert themselves."""
    root = np.float32(np.sqrt(0.5))
    for k in range(index(coefficients)):
        first, half = k * index(count), index(1) if back else index(count) // index(2)
        while index(0) < half < index(count):
            for m in range(half):
                a, b = group[first + m], group[first + half + m]
                group[first + m] = root * (a + b)
                group[first + half + m] = root * (a - b)
            half = half * index(2) if back else half // index(2)
