# make demo | test | lint | bench: each installs into .venv first, once; it installs again when setup.py changes.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
TEST_WORKERS ?= 2

# Two BLAS threads on a busy two-core machine make small matrix products many times slower.
export OPENBLAS_NUM_THREADS := 1
# A sourced ROS installation, or another environment's, must not mix with the one in .venv.
unexport PYTHONPATH AMENT_PREFIX_PATH LD_LIBRARY_PATH RMW_IMPLEMENTATION _ROS_WHEELS_BOOTSTRAP_COMPLETE

.PHONY: install demo test lint bench clean

install: $(STAMP)

$(STAMP): setup.py
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 12))' \
	  || { echo "vpsto_ros needs Python 3.11 or 3.12, for example: make PYTHON=python3.12 $(MAKECMDGOALS)"; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' || { echo "Python has no venv module: apt install python3-venv"; exit 1; }
	@echo "Installing into $(VENV) (1.6 GB, a minute or two) ..."
	@$(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --use-pep517 --editable '.[ros,sim,pycma,test,lint]'
	@touch $@

demo: $(STAMP)
	$(BIN)/vpsto demo push_box

# The compiled kernels are cached on disk; one process fills the cache so that the workers do not all compile them.
test: $(STAMP)
	$(BIN)/vpsto warm-up
	$(BIN)/python -m pytest -q -n $(TEST_WORKERS)

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/mypy

bench: $(STAMP)
	$(BIN)/vpsto bench

clean:
	rm -rf $(VENV) build install log output *.egg-info .pytest_cache .ruff_cache .mypy_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
