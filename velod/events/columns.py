"""Columns of a message as kernels take them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def readonly(column: NDArray[Any], dtype: type[np.generic]) -> NDArray[Any]:
    """A contiguous read-only view (a copy only where layout or dtype differ).

    Columns decoded from the wire are read-only, those of a reader are not; numba compiles a kernel once for each
    kind it meets, so all are given to kernels as one kind.
    """
    view = np.ascontiguousarray(column, dtype).view()
    view.flags.writeable = False
    return view
