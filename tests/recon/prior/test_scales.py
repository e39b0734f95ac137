"""Evidence of means of samples against matrices, and their candidates as those of all samples."""

from collections.abc import Collection

import numpy as np

from faintfield.recon.likelihood.images import Image
from faintfield.recon.prior.evidence import Evidence, Noise
from faintfield.recon.prior.scales import CandidatesOfScales, halved, scales

KERNEL = np.array([[0.05, 0.2, 0.1], [0.3, 1.0, 0.3], [0.1, 0.2, 0.05]])


def evidence_of(shape: tuple[int, int], seed: int = 1) -> Evidence:
    generator = np.random.default_rng(seed)
    y, u, others = generator.normal(5, 1, (3, *shape)).astype(np.float32)
    coverage = generator.uniform(1, 3, shape).astype(np.float32)
    return Evidence(y, u, Noise(np.full(shape, 4, np.float32), KERNEL), coverage, others)


def averaging_matrix(shape: tuple[int, int]) -> Image:
    """Weights of samples in means, before they are divided by their sums: 1, 6, 6 and 1 along both axes."""
    along = []
    for length in shape:
        matrix = np.zeros((-(-length // 2), length + 3))
        for mean in range(len(matrix)):
            matrix[mean, 2 * mean : 2 * mean + 4] = np.array([1, 6, 6, 1]) / 14
        along.append(matrix[:, 1 : length + 1])
    return np.asarray(np.einsum("ik,jl->ijkl", *along))


def test_noise_of_means_follows_from_covariance() -> None:
    shape = (12, 12)
    covariance = np.zeros((*shape, *shape))
    for row, column in np.ndindex(shape):
        for down, right in np.ndindex(3, 3):
            other = row + down - 1, column + right - 1
            if 0 <= other[0] < 12 and 0 <= other[1] < 12:
                covariance[row, column, *other] = 4 * KERNEL[down, right]
    matrix = averaging_matrix(shape).reshape(36, 144)
    expected = (matrix @ covariance.reshape(144, 144) @ matrix.T).reshape(6, 6, 6, 6)
    noise = halved(evidence_of(shape)).noise
    inner = (slice(1, -1), slice(1, -1))
    np.testing.assert_allclose(noise.variance[inner], np.einsum("ijij->ij", expected)[inner], rtol=1e-6)
    around = expected[2, 2, 1:4, 1:4]
    np.testing.assert_allclose(noise.kernel, around / around[1, 1], atol=1e-12)


def test_noise_of_means_correlates_as_that_of_samples() -> None:
    along = np.array([0.25, 1, 0.25])
    evidence = evidence_of((16, 16))
    evidence = evidence._replace(noise=evidence.noise._replace(kernel=np.outer(along, along)))
    for coarse in (halved(evidence), halved(halved(evidence))):
        np.testing.assert_allclose(coarse.noise.kernel, np.outer(along, along), atol=0.01)


def test_means_count_each_sample_as_it_is_seen() -> None:
    evidence = evidence_of((9, 8))
    evidence.coverage[:2, :2] = [[0, 2], [1, 1]]
    evidence.coverage[4:, 2:] = 0
    evidence.noise.variance[evidence.coverage == 0] = np.inf
    coarse = halved(evidence)
    weights = averaging_matrix((9, 8)) * evidence.coverage
    sums = weights.sum(axis=(2, 3))
    assert (sums == 0).any()
    np.testing.assert_allclose(coarse.coverage, sums, rtol=1e-6)
    for name in ("picture", "pilot", "other_colours"):
        expected = np.einsum("ijkl,kl->ij", weights, getattr(evidence, name)) / np.where(sums > 0, sums, 1)
        np.testing.assert_allclose(getattr(coarse, name), expected, rtol=1e-5, err_msg=name)
    np.testing.assert_array_equal(np.isinf(coarse.noise.variance), sums == 0)
    share = coarse.noise.variance[1, 1] / 4
    np.testing.assert_allclose(coarse.noise.variance[sums > 0], 4 * share, rtol=1e-6)


def test_candidates_of_means_change_pilot_between_samples_linearly() -> None:
    evidence = evidence_of((130, 129))
    row, column = np.mgrid[:130, :129]
    made: list[tuple[tuple[int, ...], Collection[str] | None]] = []

    def slanted(evidence: Evidence, names: Collection[str] | None = None) -> dict[str, Image]:
        """Return the pilot plus a plane that slants: 3 + 0.5 row + 0.25 column, in samples of the finest scale."""
        made.append((evidence.pilot.shape, names))
        step = 2 ** (len(made) - 1)
        down, right = (step * (at + 0.5) - 0.5 for at in np.mgrid[: evidence.pilot.shape[0], : evidence.pilot.shape[1]])
        return {"tv": evidence.pilot, "slanted": evidence.pilot + (3 + 0.5 * down + 0.25 * right).astype(np.float32)}

    found = CandidatesOfScales([slanted] * 3)(evidence)
    assert list(found) == ["tv", "slanted", "half slanted", "quarter slanted"]
    assert [shape for shape, _ in made] == [(130, 129), (65, 65), (33, 33)]
    expected = evidence.pilot + 3 + 0.5 * row + 0.25 * column
    for name in ("slanted", "half slanted", "quarter slanted"):
        inner = (slice(4, -4), slice(4, -4))
        np.testing.assert_allclose(found[name][inner], expected[inner], atol=1e-4, err_msg=name)


def test_only_scales_of_named_candidates_are_made() -> None:
    asked: list[tuple[int, Collection[str] | None]] = []

    def watched(evidence: Evidence, names: Collection[str] | None = None) -> dict[str, Image]:
        asked.append((len(evidence.pilot), names))
        return {"tv": evidence.pilot, "zero": 0 * evidence.pilot}

    found = CandidatesOfScales([watched] * 3)(evidence_of((128, 128)), {"tv", "quarter zero"})
    assert asked == [(128, {"tv"}), (32, {"zero"})]
    assert set(found) == {"tv", "zero", "quarter zero"}
    assert [len(evidence.pilot) for evidence in scales(evidence_of((101, 150)))] == [101, 51]
    assert len(CandidatesOfScales([watched])(evidence_of((128, 128)))) == 2
