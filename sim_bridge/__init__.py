"""Everything simulated: the robot cell, its driver, the demos and the experiments."""

import os

# Before NumPy is imported: a second BLAS thread makes small products 5 to 40 times slower on a busy machine.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
