# Two commands do everything on a fresh clone: `make demo` and `make test`.
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin
DEMO ?= demo
# Files over all cores, in the order of tests/conftest.py: the longest first.
SPREAD = -n auto --dist loadscope --no-loadscope-reorder

export OMP_NUM_THREADS ?= 1
# Bytecode is kept whatever the shell says: pip compiles none here, and each of many processes would, 1.3 s a time.
export PYTHONDONTWRITEBYTECODE =

.PHONY: help demo test soak lint types docs examples figures benchmarks release wheel clean
.DEFAULT_GOAL := help

help:  ## list the targets
	@grep -E '^[a-z]+:.*## ' Makefile | sed 's/:.*## /\t/'

demo: $(VENV)/.ready $(VENV)/.compiled  ## the main job on a simulated mission: a table, pictures and a page in ./demo
	$(BIN)/spplanes demo --out $(DEMO) --overwrite

test:  ## all tests
	$(MAKE) --jobs 2 $(VENV)/.ready-dev $(VENV)/.kernels
	$(BIN)/python -m pytest $(SPREAD)

soak: $(VENV)/.ready-dev $(VENV)/.kernels  ## fuzzing and killed runs, repeated often: not among all tests
	$(BIN)/python -m pytest $(SPREAD) --soak

lint: $(VENV)/.ready-dev  ## ruff, lint and format
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.ready-dev  ## pyrefly
	$(BIN)/pyrefly check

docs: $(VENV)/.ready-dev  ## the documentation site in ./build/docs, warnings as errors, offline
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs build/docs

examples: $(VENV)/.ready-dev  ## run every example
	for example in examples/*.py; do echo "== $$example"; $(BIN)/python $$example || exit 1; done

figures: $(VENV)/.ready  ## the pictures of README and docs
	$(BIN)/python tools/figures.py
	$(BIN)/python tools/convention_figures.py

benchmarks: $(VENV)/.ready-dev  ## ratios side by side (slow)
	$(BIN)/python -m benchmarks

release:  ## sdist and wheel in ./dist, checked, installed and run under every supported Python that is here (minutes)
	$(PYTHON) tools/release.py

wheel: $(VENV)/.ready-dev  ## a wheel in ./dist that brings its kernels compiled, and a check that nothing is compiled
	SPPLANES_KERNELS=all $(BIN)/pip wheel --quiet --no-deps --no-build-isolation --wheel-dir dist .
	SPPLANES_WHEEL=$$(ls -t dist/*.whl | head -1) $(BIN)/python -m pytest tests/test_wheel.py

clean:  ## remove the environment and everything generated
	rm -rf $(VENV) $(DEMO) build dist .pytest_cache .ruff_cache .hypothesis

$(VENV)/.ready: pyproject.toml constraints.txt tools/bootstrap.py
	$(PYTHON) tools/bootstrap.py $(VENV)
	@touch $@

$(VENV)/.compiled: $(VENV)/.ready tools/compile_kernels.py
	$(BIN)/python tools/compile_kernels.py --run corridor --run pieces
	@touch $@

# beside .ready-dev: kernels need none of the large packages that it installs
$(VENV)/.kernels: $(VENV)/.ready tools/compile_kernels.py
	-$(BIN)/python tools/compile_kernels.py
	@touch $@ $(VENV)/.compiled

$(VENV)/.ready-dev: $(VENV)/.ready
	$(PYTHON) tools/bootstrap.py $(VENV) --dev
	@touch $@
