# make demo   from nothing to a profile and a picture
# make test   from nothing to a passed test suite
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
PIP    := $(BIN)/python -m pip --disable-pip-version-check
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1

.PHONY: help demo test test-all test-postgresql docs bench bench-chain soak lint dev constraints clean

help:
	@echo "make demo      install, simulate a small recording, profile it, draw a report"
	@echo "make test      install and run the test suite"
	@echo "make test-all  the same with the slow science checks;  make test-postgresql: the catalog on a server of its own"
	@echo "make docs      the documentation as pages, docs/_build/html/index.html"
	@echo "make bench     every benchmark, as ratios;  make bench-chain: chain against reading"
	@echo "make soak      runs for two hours (SOAK=10m: as long as you like): do memory and open files stay flat?"
	@echo "make lint      ruff and mypy;  make dev: what an editor needs"

$(VENV)/.python:
	@command -v $(PYTHON) >/dev/null || { echo "make: no $(PYTHON) on this machine; install Python 3.11 or later," \
	  "or name it: make PYTHON=/path/to/python3 $(MAKECMDGOALS)"; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "make: $$($(PYTHON) --version) is too old;" \
	  "coslidar needs Python 3.11 or later: make PYTHON=/path/to/python3 $(MAKECMDGOALS)"; exit 1; }
	@$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); echo "make: $(PYTHON) cannot make a virtual environment; on Debian and" \
	  "Ubuntu: apt install python3-venv"; exit 1; }
	@touch $@

$(VENV)/.core: $(VENV)/.python pyproject.toml constraints.txt
	@echo "installing coslidar into $(VENV) (about a minute) ..."
	@$(PIP) install -qq -c constraints.txt -e . || { echo "make: the installation failed; pip needs a package index" \
	  "(PyPI or a mirror) to reach"; exit 1; }
	@touch $@

$(VENV)/.test: $(VENV)/.core tests/example_plugin/pyproject.toml
	@echo "installing the test tools ..."
	@$(PIP) install -qq -c constraints.txt -e ".[test,dev]" || { echo "make: the installation failed; pip needs a package" \
	  "index (PyPI or a mirror) to reach"; exit 1; }
	@$(PIP) install -qq --no-deps -e tests/example_plugin || { echo "make: the example plugin could not be" \
	  "installed"; exit 1; }
	@touch $@

demo: $(VENV)/.core
	@$(BIN)/coslidar init demo --scenario demo
	@$(BIN)/coslidar run demo/campaign.toml
	@$(BIN)/coslidar report demo/campaign.toml -o demo/report.html
	@echo
	@echo "Next:  open demo/report.html in a browser"
	@echo "       $(BIN)/coslidar catalog ls --out demo/results     what has been computed"
	@echo "       $(BIN)/coslidar init my-campaign                  a campaign file for your own recordings"

test: $(VENV)/.test
	@$(BIN)/python -m pytest -q -m "not slow" -n auto --dist loadfile $(PYTEST_ARGS)
	@echo "All tests passed.  Next: make demo, or make test-all for the slow science checks."

test-all: $(VENV)/.test
	@$(BIN)/python -m pytest -q -n auto --dist loadfile $(PYTEST_ARGS)

test-postgresql: $(VENV)/.test
	@server=$$(mktemp -u /tmp/coslidar-postgresql.XXXXXXXX); trap '.ci/postgresql stop '$$server EXIT; \
	  url=$$(.ci/postgresql start $$server) && COSLIDAR_TEST_POSTGRESQL=$$url $(BIN)/python -m pytest -q \
	  tests/unit/test_catalog*.py tests/flows/test_catalog_commands.py -k postgresql $(PYTEST_ARGS)

$(VENV)/.docs: $(VENV)/.core
	@echo "installing what builds the documentation ..."
	@$(PIP) install -qq -c constraints.txt -e ".[docs]" || { echo "make: the installation failed; pip needs a package" \
	  "index (PyPI or a mirror) to reach"; exit 1; }
	@touch $@

docs: $(VENV)/.docs
	@$(BIN)/python -m sphinx -q -W --keep-going -b html docs docs/_build/html
	@echo "Next:  open docs/_build/html/index.html in a browser"

bench: $(VENV)/.test
	@for b in benchmarks/bench_*.py; do echo "== $$b"; $(BIN)/python $$b || exit 1; done

bench-chain: $(VENV)/.test
	@$(BIN)/python benchmarks/bench_chain.py

SOAK ?= 2h
soak: $(VENV)/.test
	@$(BIN)/python benchmarks/soak.py --for $(SOAK)

lint: dev
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy -p coslidar.pipeline -p coslidar.plugins -p coslidar.catalog -p coslidar.flows

dev: $(VENV)/.test
	@mkdir -p .dev && ln -sfn .. .dev/coslidar

constraints: $(VENV)/.test
	@{ sed -n '/^#/p' constraints.txt; $(PIP) freeze --exclude-editable; } > constraints.new && mv constraints.new constraints.txt

clean:
	rm -rf $(VENV) .dev demo bench-data build docs/_build docs/reference *.egg-info
