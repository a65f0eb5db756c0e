# make demo     measures the bundled clip and names the report
# make test     checks style and types and runs the tests but for the slow ones
# make test-all the same with the slow ones: before a release
# make lint     only the checks
# make results  reproduces both papers' tables and figures in docs/results.md; goes on where it was interrupted
# make lock     renews the lock files (for maintainers; needs uv)
# make clean    removes what the others made

PYTHON = python3
VENV = .venv
BIN = $(VENV)/bin
PIP = $(BIN)/python -m pip --disable-pip-version-check --quiet
INSTALL = $(PIP) install --no-compile --require-hashes --only-binary :all:
INSTALL_PACKAGE = $(PIP) install --no-deps --no-build-isolation --editable .
LOCK = uv pip compile pyproject.toml --universal --python-version 3.11 --fork-strategy fewest --generate-hashes \
	--no-emit-index-url --no-emit-find-links --no-annotate --custom-compile-command "make lock" --quiet --group build

# Tests go out in order, in chunks that shrink: few modules prepare their fixtures twice, and no worker waits at the end.
# (Work stealing left three workers waiting for each other.)
PYTEST = $(BIN)/python -m pytest -n auto --dist load

# Without compiled modules beside the sources, which some environments ask for, every process compiles all that it imports.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test test-all ready-for-tests lint results lock clean

demo: $(VENV)/installed
	$(BIN)/paceline speed examples/straight/clip.yaml -o demo
	@if [ -n "$$DISPLAY$$WAYLAND_DISPLAY" ] && command -v xdg-open > /dev/null; then xdg-open demo/report.html; fi

test: ready-for-tests
	$(PYTEST) -m "not slow"

test-all: ready-for-tests
	$(PYTEST) --hypothesis-profile default

# What the tests need is installed while Numba compiles what else each worker would compile for itself.
ready-for-tests: $(VENV)/installed
	@$(MAKE) --no-print-directory -j2 $(VENV)/installed-for-tests $(VENV)/compiled

lint: $(VENV)/installed-for-tests
	$(BIN)/ruff check .
	$(BIN)/mypy

results: $(VENV)/installed-for-tests
	OPENBLAS_NUM_THREADS=1 OMP_WAIT_POLICY=passive $(BIN)/python benchmarks/reproduce.py zhu2012.document

lock:
	$(LOCK) -o requirements.txt
	$(LOCK) --group dev --constraint requirements.txt -o requirements-dev.txt

clean:
	rm -rf $(VENV) demo build dist .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(VENV)/made:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "Paceline needs Python 3.11 or newer; name one with: make PYTHON=python3.12" >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2> /dev/null || \
		{ echo "Python's venv module is missing; on Debian or Ubuntu: apt install python3-venv" >&2; exit 1; }
	$(PYTHON) -m venv --clear $(VENV)
	@touch $@

$(VENV)/installed: requirements.txt pyproject.toml $(VENV)/made
	@echo "Installing Paceline into $(VENV); the first time this takes a minute or two"
	$(INSTALL) -r requirements.txt
	$(INSTALL_PACKAGE)
	@touch $@

$(VENV)/installed-for-tests: requirements-dev.txt $(VENV)/installed
	$(INSTALL) -r requirements-dev.txt
	@touch $@

$(VENV)/compiled: $(VENV)/installed
	@rm -rf $@; mkdir $@
	@$(BIN)/paceline follow examples/chase -o $@/follow --quiet & \
		{ $(BIN)/paceline speed examples/straight -o $@/speed --quiet; \
		$(BIN)/paceline vehicles examples/straight --quiet; }; wait
