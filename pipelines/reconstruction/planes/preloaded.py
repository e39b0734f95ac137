"""All that a process of `--workers` needs, loaded by the one that they are copied from; not for others to import."""

from numba.core.registry import cpu_target

import faintfield.pipelines.reconstruction.planes.cluster  # noqa: F401

cpu_target.target_context.refresh()  # half a second, which each process would spend before its first kernel
