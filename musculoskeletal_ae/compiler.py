# SPDX-License-Identifier: Apache-2.0
"""numba's `njit`, without two things that numba loads on the way and no code here needs.

They are BLAS for products in compiled code, and with it all of scipy.linalg, and the measuring of
test coverage: together a third of a second and 20 MB of every process that simulates.
"""

import sys

_UNUSED = {'coverage', 'scipy.linalg.cython_blas'} - sys.modules.keys()
sys.modules.update(dict.fromkeys(_UNUSED))  # type: ignore[arg-type]  # None: it cannot be imported
try:
    # It asks for BLAS when it is loaded: now, and not at the first call.
    import numba.np.arraymath  # noqa: F401
    from numba import njit as njit
finally:
    for name in _UNUSED:
        del sys.modules[name]
