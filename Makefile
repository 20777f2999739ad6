# Two commands matter to a newcomer: `make run` and `make test`. What `make test` leaves out, `make test-all` adds.
# Everything is installed into .venv; a fresh machine needs python3 (3.11 or newer) with venv, and make.

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
UV := $(shell command -v uv 2>/dev/null)

ifdef UV
CREATE = $(UV) venv --quiet --seed --allow-existing --python $(PYTHON) $(VENV)
INSTALL = $(UV) pip install --quiet --python $(BIN)/python --constraint constraints.txt
else
CREATE = $(PYTHON) -m venv $(VENV)
INSTALL = $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile --constraint constraints.txt
endif
# pip compiles one file after the other, which takes as long as all the rest; this takes every core.
COMPILE = $(BIN)/python -m compileall -qq -j 0 -x '/tests/' $(VENV)/lib || true

.PHONY: run plant test test-slow test-all histories hardships install lint types layers docs bundle simulated-model thermal-zoo clean

run: $(VENV)/.installed
	$(BIN)/toolpoint demo

# Broker, PostgreSQL, Grafana and ten simulated machines: `make plant PLANT="--machines 3 --way packages"`.
plant: $(VENV)/.installed
	$(BIN)/python systemd/plant/plant.py $(PLANT)

install: $(VENV)/.installed

# Three processes more than there are cores, because tests on wires mostly wait. The tests of one file stay in one process,
# so that they share what they set up, and the longest files come first (tests/conftest.py).
PROCESSES ?= $(shell expr $$(nproc) + 3)
# What is compiled is kept: every process of the tests would compile and rewrite all of them.
PYTEST = $(BIN)/python -m compileall -q config daemon drivers models tests/support && \
  PYTHONDONTWRITEBYTECODE= OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest --numprocesses $(PROCESSES) --dist loadfile

test: $(VENV)/.installed-dev
	$(PYTEST) -m "not slow"

test-slow: $(VENV)/.installed-dev
	$(PYTEST) -m slow

test-all: $(VENV)/.installed-dev
	$(PYTEST)

# Random histories of faults and of bad input, of each kind TIMES as many as `make test-all` plays; one takes about 0.4 s.
TIMES ?= 60
histories: $(VENV)/.installed-dev
	$(PYTEST) --dist load -m slow --histories $(TIMES) \
	  tests/daemon/test_truth_of_combined_faults.py tests/daemon/test_truth_after_bad_input.py \
	  tests/daemon/test_cnc_histories.py tests/daemon/test_truth_of_spindle_speed.py
	$(PYTEST) --histories $(TIMES) tests/models/test_compensation_truth.py

# Kills, power cuts, full disks, clocks that are set, lost wires, on real processes and wires; about an hour and a half.
hardships: $(VENV)/.installed-dev
	$(BIN)/python -P tests/hardships/run.py $(HARDSHIPS)

lint: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.installed-dev
	$(BIN)/mypy

layers: $(VENV)/.installed-dev
	$(BIN)/lint-imports

# The reference pages that are made from the code.
docs: $(VENV)/.installed
	$(BIN)/python docs/reference/render_configuration.py > docs/reference/configuration.md
	$(BIN)/python docs/reference/render_spindle_file.py > docs/reference/spindle-file.md
	$(BIN)/python docs/reference/render_commands.py > docs/reference/commands.md
	$(BIN)/python docs/reference/render_api.py > docs/reference/api.md
	$(BIN)/python docs/reference/render_messages.py > docs/reference/messages.md

# Fit the model of the simulated machine anew, on simulated days that are not the demo's.
simulated-model: $(VENV)/.installed
	$(BIN)/python -P -m daemon.simulation.simulated_model

# Every family of thermal models on every machine of tests/zoo: `make thermal-zoo ZOO="--half tuning --machines 5"`.
thermal-zoo: $(VENV)/.installed-dev
	OPENBLAS_NUM_THREADS=1 $(BIN)/python tests/zoo/zoo.py $(ZOO)

# Everything that an installation without a network needs, as one tar in dist/. With what sinks need beyond it:
# `make bundle EXTRAS=sparkplug,parquet`; with what `fleet train --dask` needs: `dask` too.
EXTRAS ?= sparkplug
bundle: $(VENV)/.installed-dev dist/bundle/wheels
	echo '$(EXTRAS)' > dist/bundle/extras
	$(BIN)/python -P .ci/bill_of_materials.py dist/bundle/wheels package-lock.json dist/bundle/sbom.cdx.json
	cp -r systemd constraints.txt README.md LICENSE CHANGELOG.md docs dist/bundle/
	mv dist/bundle/systemd/install.sh dist/bundle/
	cd dist/bundle && find . -type f ! -name SHA256SUMS -print0 | sort -z | xargs -0 sha256sum > SHA256SUMS
	name=toolpoint-$$(basename dist/bundle/wheels/toolpoint-*.whl | cut -d- -f2)-$$(uname -m); \
	  rm -rf dist/$$name dist/$$name.tar; mv dist/bundle dist/$$name; \
	  tar --create --file dist/$$name.tar --directory dist --owner=0 --group=0 $$name && ls -l dist/$$name.tar

# Needs nothing of what is installed for development; `bundle` takes it away.
dist/bundle/wheels: $(VENV)/.created
	rm -rf dist/bundle
	mkdir -p dist/bundle/collected
	$(BIN)/python -m pip wheel --quiet --disable-pip-version-check --constraint constraints.txt --wheel-dir dist/bundle/collected '.[$(EXTRAS)]'
	mv dist/bundle/collected $@

$(VENV)/.created:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "Toolpoint needs Python 3.11 or newer; name one: make PYTHON=python3.11 ..."; exit 1; }
	@echo "Installing into $(VENV); the first time takes some minutes."
	$(CREATE)
	touch $@

$(VENV)/.installed: $(VENV)/.created pyproject.toml constraints.txt
	$(INSTALL) --editable .
	$(COMPILE)
	touch $@

$(VENV)/.installed-dev: $(VENV)/.created pyproject.toml constraints.txt
	$(INSTALL) --editable '.[dev,parquet]'
	$(COMPILE)
	touch $@ $(VENV)/.installed

clean:
	rm -rf $(VENV) build dist .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
