# make demo        recover a scene from images, this library against the usual loop, at equal time; a page with the result
# make asset       from photographs, which it renders, to an asset: import, descent in stages, judgement, turntable, exports
# make test        lint, types of the sources, and the quick tests: every feature, in a few minutes
# make test-all    every test
# make test-slow   the tests that `make test` leaves out
# make test-unit   the tests that need no Mitsuba alone, in about a minute
# make lint        lint and all types
# make docs        the documentation site, in build/site; its notebooks are executed, warnings are errors
# make package     wheel and source archive, in dist; the wheel is installed into an empty environment and started there
# make audit       known vulnerabilities of the locked versions, by pip-audit and PyPI's database
# make clean       remove what these wrote (the virtual environment stays)
#
# Everything is set up on the way, in .venv. Settings, after the target:
#   PYTHON=python3.12   the interpreter, 3.10 to 3.14
#   WORKERS=4           test processes; one more than cores, at most 4, unless said otherwise
#   DRJIT_CACHE_DIR=x   the folder that keeps compiled kernels, .pytest_cache/kernels; in an empty one a run takes twice the time
#   SECONDS=30          of the demo, per method; of the asset, of all stages together

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help demo asset test test-all test-slow test-unit lint docs package audit clean

FIND_PYTHON = for python in python3 python3.14 python3.13 python3.12 python3.11 python3.10; do \
	$$python -c 'import sys; sys.exit(not (3, 10) <= sys.version_info < (3, 15))' 2>/dev/null && { command -v $$python; break; }; done
PYTHON ?= $(shell $(FIND_PYTHON))
BIN := .venv/bin
SECONDS := 30
# LLVM compiles a kernel on one core, so a process for each, and one more, since some tests wait for processes that they start. The tests of a
# file stay in one process, since they share kernels.
WORKERS = $(shell n=$$(getconf _NPROCESSORS_ONLN 2>/dev/null || echo 1); test $$n -lt 4 && echo $$((n + 1)) || echo 4)
PYTEST = $(BIN)/python -m pytest -q --durations=10 -n $(WORKERS) --dist loadfile --max-worker-restart=2
TYPES = $(BIN)/pyright --pythonpath $(BIN)/python
# Types of the sources take half a minute of one core: they are checked beside the tests, told after them, and checked again only if a source or
# the installed packages have changed. `make lint` checks all types.
CHECKED := .pytest_cache/types-checked
SOURCES = { ls $(BIN)/../lib/*/site-packages; find src -name '*.py' | LC_ALL=C sort | xargs cksum pyproject.toml; } | cksum
define WITH_LINT
	$(BIN)/ruff check .
	@mkdir -p .pytest_cache
	@( sources=$$($(SOURCES)); if [ "$$sources" = "$$(cat $(CHECKED) 2>/dev/null)" ]; then echo "types of the sources: unchanged since the last check"; \
	   elif $(TYPES) src; then echo "$$sources" > $(CHECKED); else exit 1; fi ) > .pytest_cache/types.txt 2>&1 & types=$$!; \
	$(PYTEST) $(1); tests=$$?; \
	wait $$types; types=$$?; cat .pytest_cache/types.txt; exit $$((tests + types))
endef
# What does best for the usual loop on this problem in 20 seconds. Ours has no option.
TUNED := --set stock.spp=16 --set stock.learning_rate=0.05
export PYRIGHT_PYTHON_IGNORE_WARNINGS := 1

help:
	@sed -n '/^#/!q; s/^# \{0,1\}//p' Makefile

demo: .venv/ready
	$(BIN)/unrender compare indirect-room --seconds $(SECONDS) --out out/demo --overwrite $(TUNED)
	@echo "the result, to open in a browser: file://$(CURDIR)/out/demo/compare.html"

asset: .venv/ready
	rm -rf out/asset
	$(BIN)/python -c 'import unrender; unrender.gallery.photographs("out/asset/photographs")'
	$(BIN)/unrender import out/asset/photographs --out out/asset/problem
	$(BIN)/unrender run out/asset/problem/stages.toml --seconds $(SECONDS) --out out/asset/run
	$(BIN)/unrender judge out/asset/run --out out/asset/judge
	$(BIN)/unrender turntable out/asset/run --out out/asset/turntable.gif
	$(BIN)/unrender export out/asset/run --format mitsuba,glb,obj,environment,blender --out out/asset/export
	@echo "held-out photographs beside renders: file://$(CURDIR)/out/asset/judge/sheet.png; the asset: out/asset/export"

test: .venv/ready
	$(call WITH_LINT,-m "not slow" -o faulthandler_timeout=400)

test-all: .venv/ready
	$(call WITH_LINT,)

test-slow: .venv/ready
	$(PYTEST) -m slow

test-unit: .venv/ready
	$(PYTEST) -m "not mitsuba and not slow" tests/unit

lint: .venv/ready
	$(BIN)/ruff check .
	@mkdir -p .pytest_cache
	sources=$$($(SOURCES)); $(TYPES) && echo "$$sources" > $(CHECKED)

docs: .venv/docs-ready
	$(BIN)/python -m sphinx -W --keep-going -E -c scripts/site -b html docs build/site
	@echo "the site: file://$(CURDIR)/build/site/index.html"

package: .venv/ready
	$(BIN)/python -I scripts/package.py

# In an environment of its own, so that its packages are none of ours. A version that the database does not know is an error.
audit:
	$(PYTHON) -m venv .venv/audit
	.venv/audit/bin/python -m pip install --quiet --disable-pip-version-check pip-audit
	.venv/audit/bin/pip-audit --strict --no-deps --disable-pip --requirement requirements/ci.lock

clean:
	rm -rf out build dist .pytest_cache .ruff_cache .hypothesis
	find src tests benchmarks scripts -name __pycache__ -type d -prune -exec rm -rf {} +

# Made anew whenever the dependencies change. pyright fetches its own program when it is first called: let that be now.
.venv/ready: pyproject.toml scripts/prerequisites.py src/unrender/backend/llvm.py src/unrender/backend/install_hints.py
	@test -n "$(PYTHON)" || { echo "no Python from 3.10 to 3.14 found: install one, or run: make PYTHON=/path/to/python3" >&2; exit 3; }
	@$(PYTHON) -I scripts/prerequisites.py
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[dev]'
	@$(BIN)/pyright --version
	@touch $@

.venv/docs-ready: .venv/ready
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[docs]'
	@touch $@
