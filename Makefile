# Each target works alone on a fresh Debian or Ubuntu with Python 3.11 or newer; `make PYTHON=/path/to/python3 setup` chooses one.
# ONLY=group restricts accuracy and benchmark to one group; ARGS="-k camera" goes to pytest.

PYTHON ?=
ONLY ?=
REAL := $(or $(SONOTWIN_REAL),$(wildcard ../shared/real))
ARGS ?=
BIN := .venv/bin
INSTALLED := .venv/.installed
TWIN := .venv/.twin
LIVE := outputs/live
# Each worker takes one half of the tests, so that few make the same fixtures; who is done helps the other.
PYTEST := $(BIN)/python -m pytest -n 2 --dist worksteal
# Compiled sources are kept, whatever the shell says: else each command that a test starts, and each worker, compiles all anew.
export PYTHONDONTWRITEBYTECODE :=

.DEFAULT_GOAL := help
.PHONY: help setup demo live test lint slow docs accuracy benchmark campaign paper clean

help:  ## show this
	@sed -n 's/^\([a-z]*\):.*## \(.*\)/make \1 \t\2/p' $(MAKEFILE_LIST) | expand -t 18

setup: $(INSTALLED)  ## make .venv and install everything that demo and tests need; the others install what they need
	@:

$(INSTALLED): pyproject.toml constraints.txt .ci/setup
	@PYTHON="$(PYTHON)" bash .ci/setup
	@touch $(TWIN) $@

# The demo needs neither the tools of development nor PyTorch, which take half of the time to install.
$(TWIN): pyproject.toml constraints.txt .ci/setup
	@PYTHON="$(PYTHON)" bash .ci/setup twin
	@touch $@

demo: $(TWIN)  ## render a phantom, reconstruct its surface, compare with the truth
	@$(BIN)/sonotwin demo

live: $(LIVE)/result/metrics.json  ## play a rendered scene as the rig would, live in the browser; needs no hardware
	@$(BIN)/sonotwin navigate capture=$(LIVE)/capture lag_s=0.05 tissue_m_s=1450 skin=$(LIVE)/result/surface/surface.ply \
		masses=$(LIVE)/result/masses/scan $(ARGS)

# Skin, a filmed sweep, and what is found in them: minutes, once.
$(LIVE)/result/metrics.json: | setup
	@$(BIN)/sonotwin render scene=breast add=true out=$(LIVE)
	@$(BIN)/sonotwin sweep scene=breast path=raster filmed=true clocks.camera_hz=25 name=scan add=true out=$(LIVE)
	@$(BIN)/sonotwin reconstruct capture=$(LIVE)/capture lag_s=0.05 tissue_m_s=1450 out=$(LIVE)/result

test: setup  ## check style, types and arrows, then run the fast tests
	@bash .ci/browser & browser=$$!; $(MAKE) --no-print-directory lint && wait $$browser
	@$(PYTEST) -m "not slow" $(ARGS)

lint: setup  ## check style, types and which package may import which
	@$(BIN)/ruff check --quiet .
	@$(BIN)/ruff format --check --quiet .
	@$(BIN)/pyrefly check --summary=none --output-format min-text
	@said=$$($(BIN)/lint-imports --no-logo) || { echo "$$said"; exit 1; }

slow: setup  ## run the slow tests
	@$(PYTEST) -m slow $(ARGS)

docs: setup  ## build the documentation site, build/docs/index.html
	@$(BIN)/python -m sphinx -q -W --keep-going -c docs -d build/doctrees . build/docs
	@echo "make docs: build/docs/index.html"

accuracy: setup  ## measure errors against the ground truth and the paper's figures
	@$(BIN)/sonotwin accuracy document=docs/accuracy.md $(if $(ONLY),only=$(ONLY)) $(if $(REAL),real=$(REAL))

benchmark: setup  ## measure speed
	@$(BIN)/python -m benchmarks $(ONLY)

# Hours; parts that have a table in outputs/campaign/ are kept, and ONLY=part does one anew.
campaign: setup  ## attack every command: bad inputs, mistakes, fuzzing, kills, full disks, two writers, long runs
	@$(BIN)/python -m campaign $(ONLY) $(ARGS)

# Hours; goes on where it was stopped. Trials are shared: planes, sphere and optics are figures of the same laboratories, and so are
# probe and cylinders.
PAPER := optics planes sphere probe cylinders breast ultrasound_causes
paper: setup  ## repeat the paper's experiments in full, by its method and by ours
	@for name in $(if $(ONLY),$(ONLY),$(PAPER)); do \
		$(BIN)/sonotwin study name=$$name out=outputs/paper/$$name trials=outputs/paper/trials document=docs/paper.md engine.workers=2 || exit; \
	done

clean:  ## delete compiled code and caches; .venv and outputs stay
	@rm -rf build docs/reference/packages .pytest_cache .ruff_cache .import_linter_cache
	@find . -name __pycache__ -not -path './.venv/*' -prune -exec rm -rf {} +
