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

# Reference patches of a row whose members are found together: what they are compared with stays in the cache.
_COLUMNS_AT_A_TIME = 32

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
def find_groups(guide, rows, columns, size, radius, groups):
    """Find the patches that are most like each reference patch, the most alike first.

    Parameters
    ----------
    guide : float32 array (row, column)
        A picture l in which patches are compared. A patch with NaN has no group.
    rows, columns : int array
        First row and column of the reference patches.
    size, radius : int
        Samples of a patch along each side; largest distance of a member from its reference, along rows and columns.
    groups : int16 array (row, column, member)
        The places of the members, as `_place` numbers them; −1 where there are no more.
    """
    distances = np.empty((_COLUMNS_AT_A_TIME, groups.shape[2]), np.float32)
    squares = np.empty(guide.shape[1], np.float32)
    for n in range(rows.size):
        for first in range(0, columns.size, _COLUMNS_AT_A_TIME):
            part = slice(first, first + _COLUMNS_AT_A_TIME)
            _find_alike(guide, rows[n], columns[part], size, radius, squares, distances, groups[n, part])


@compiled
def filter_rows(picture, pilot, variance, rows, columns, radius, groups, threshold, transform, wiener, large):
    """Filter the groups of all reference patches whose first samples lie in `rows` x `columns`.

    Parameters
    ----------
    picture, pilot, variance : float32 array (row, column)
        y, u, and the variance of y.
    rows, columns, radius, groups : int array, int array, int, int16 array (row, column, member)
        The reference patches and their groups, as for `find_groups`.
    threshold : float
        Least magnitude of the coefficients that the second filter keeps, in standard deviations of their noise.
    wiener, large : float32 array (2, row, column)
        Sums of two filters, Wiener's and one that keeps large coefficients, to which the filtered patches times their
        weights, and the weights, are added. An array without samples leaves a filter out.
    """
    size, members, width = transform.window.shape[0], groups.shape[2], picture.shape[1]
    starts = np.empty(members, np.uintp)
    patches = np.empty((4, size * size * members), np.float32)
    for n in range(rows.size):
        for k in range(columns.size):
            count = _first_samples(groups[n, k], rows[n] * width + columns[k], radius, width, starts)
            if count > 0:
                _filter_group(picture, pilot, variance, starts[:count], threshold, transform, patches, wiener, large)


@compiled
def _place(down, right, radius):
    """Return the number of a place at most `radius` samples from a reference, along rows and columns."""
    return (down + radius) * (2 * radius + 1) + right + radius


@compiled
def _first_samples(group, reference, radius, width, starts):
    """Set `starts` to the first samples of a group's patches in the flat picture; return their number, a power of two.

    Each member goes to the slot with its bits in reverse order: then the halves of the group, `m` and `m + count/2`,
    are neighbours in the order of their distances.
    """
    count = 1
    while 2 * count <= group.size and group[2 * count - 1] >= 0:
        count *= 2
    if group[0] < 0:
        return 0
    for m in range(count):
        down, right = group[m] // (2 * radius + 1) - radius, group[m] % (2 * radius + 1) - radius
        starts[_reversed_bits(index(m), index(count))] = index(reference + down * width + right)
    return count


@compiled
def _outwards(step):
    """Return 0, 1, −1, 2, −2 … for 0, 1, 2, 3, 4 …: nearer patches are more often alike, and found first."""
    return (step + 1) // 2 if step % 2 else -(step // 2)


@compiled
def _find_alike(guide, row, columns, size, radius, squares, distances, groups):
    """Set the groups of some reference patches of a row to the patches nearest by squared distance, nearest first."""
    (height, width), members = guide.shape, index(groups.shape[1])
    groups[:] = -1
    distances[:] = np.inf
    sums = pointer(squares)
    for vertical in range(2 * radius + 1):
        down = _outwards(vertical)
        if row + down < 0 or row + down > height - size:
            continue
        for horizontal in range(2 * radius + 1):
            right = _outwards(horizontal)
            start, stop = max(columns[0], -right), min(columns[-1] + size, width - right)
            if stop - start < size:
                continue
            _sum_squares(guide, row, row + down, right, start, stop, size, squares)
            for k in range(columns.size):
                column = columns[k]
                if column >= start and column + size <= stop:
                    distance = np.float32(0)
                    for j in range(index(size)):
                        distance += sums[index(column) + j]
                    if distance < distances[k, -1]:  # never for NaN
                        first = index(k) * members
                        nearest, group = advanced(pointer(distances), first), advanced(pointer(groups), first)
                        _insert(distance, np.int16(_place(down, right, radius)), nearest, group, members)
        if distances[: columns.size, -1].max() == 0:  # as in the dark: none can be nearer
            break


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
def _insert(distance, place, distances, places, length):
    """Insert a patch into a list of the nearest ones, sorted by distance, whose last one leaves it."""
    at = length - index(1)
    while at > index(0) and distances[at - index(1)] > distance:
        distances[at], places[at] = distances[at - index(1)], places[at - index(1)]
        at -= index(1)
    distances[at], places[at] = distance, place


@compiled
def _filter_group(picture, pilot, variance, starts, threshold, transform, patches, wiener, large):
    """Filter the patches of a group by each filter, and add them to its sums."""
    size, count, width = transform.window.shape[0], starts.size, picture.shape[1]
    y, u, kept, scratch = patches[0], patches[1], patches[2], patches[3]
    middle = index(size // 2 * (width + 1))
    level = np.float32(0)
    for m in range(count):
        level += pointer(variance)[starts[m] + middle]
    level = max(level / np.float32(count), np.float32(_LEAST_VARIANCE))
    _read(picture, starts, size, y)
    _forward(y, scratch, transform, count)
    if large.size > 0:
        length = size * size * count
        for k in range(length):  # not `kept[:length] = y[:length]`, which takes seconds to compile
            kept[k] = y[k]
        left = _keep_large(kept, level, threshold, transform, count)
        _add_inverse(kept, scratch, starts, transform, level, left, large)
    if wiener.size > 0:
        _read(pilot, starts, size, u)
        _forward(u, scratch, transform, count)
        left = _shrink(y, u, level, transform, count)
        _add_inverse(y, scratch, starts, transform, level, left, wiener)


@compiled
def _forward(group, scratch, transform, count):
    """Transform a group."""
    _cosine_transform(group, scratch, transform.cosines, count)
    _haar(group, transform.window.size, count, False)


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
def _add_inverse(group, scratch, starts, transform, level, left, sums):
    """Transform a group back, and add its patches with the weight that their variance gives them."""
    size, count = transform.window.shape[0], starts.size
    _haar(group, size * size, count, True)
    _cosine_transform(group, scratch, transform.transposed, count)
    weight = np.float32(1) / (left / np.float32(count * size * size) + np.float32(_LEAST_LEFT) * level)
    _add(group, starts, size, transform.window, weight, sums[0], sums[1])


@compiled
def _read(plane, starts, size, group):
    """Copy the patches with given first samples to a group."""
    count, width, length = index(starts.size), index(plane.shape[1]), index(size)
    for m in range(count):
        for i in range(length):
            source = advanced(pointer(plane), starts[m] + i * width)
            target = advanced(pointer(group), i * length * count + m)
            for j in range(length):
                target[j * count] = source[j]


@compiled
def _add(group, starts, size, window, weight, above, below):
    """Add the patches of a group times their weights, and the weights, to the sums."""
    count, width, length = index(starts.size), index(above.shape[1]), index(size)
    total, weights = pointer(above), pointer(below)
    for m in range(count):
        for i in range(length):
            at = starts[m] + i * width
            for j in range(length):
                share = weight * window[i, j]
                total[at + j] += share * group[(i * length + j) * count + m]
                weights[at + j] += share


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
    size, length = index(cosines.shape[0]), index(count)
    x, y = pointer(group), pointer(scratch)
    for j in range(size):
        _multiply(cosines, advanced(x, j * length), advanced(y, j * length), length, size * length)
    for k in range(size):
        _multiply(cosines, advanced(y, k * size * length), advanced(x, k * size * length), length, length)


@compiled
def _multiply(matrix, source, target, length, stride):
    """Set rows of `length` numbers of the target to `Σᵢ C[k, i] x[i]`, with x the rows of the source."""
    for k in range(matrix.shape[0]):
        out = advanced(target, index(k) * stride)
        for i in range(0, matrix.shape[0], 4):
            a, b, c, d = matrix[k, i], matrix[k, i + 1], matrix[k, i + 2], matrix[k, i + 3]
            x = advanced(source, index(i) * stride)
            for t in range(length):
                sum_of_four = a * x[t] + b * x[stride + t] + c * x[index(2) * stride + t] + d * x[index(3) * stride + t]
                out[t] = sum_of_four if i == 0 else out[t] + sum_of_four


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
