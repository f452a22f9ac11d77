# make demo   install what the demo needs into .venv and run it
# make test   install what the tests need, check, and run all tests
# make check  format, lint, types, direction of imports, generated code
# make selftest  the faults of practice on a simulated site, as a table of promised and seen
# make compose-test  compose.yaml brought up, killed and cut off, in namespaces of this machine (root)
# make bench  measurements, as ratios
# make schema regenerate the code of schemas/fan.proto
# make reference  write the pages and tables of docs/reference that come from the code again
# make twin   train the demo's twin again
# make lock   pin the dependencies again
# make licences  write LICENSES.md from the locks and what is installed
# make site   the documentation site, in build/site/
# make dist   the source distribution and the wheel, in dist/
# make rerun-bump VERSION=0.42  pin Rerun to this release, and run all tests that draw with it
# make clean  remove what was built (and nothing that was recorded)

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet
COMPILE := $(BIN)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-header --no-annotate pyproject.toml
CONTAINERS := build/compose
TORCH := torch==2.13.0
BENCHES := $(addprefix bench.training.,published_table interval_coverage rough_table measured_table onnx_speed training_race) \
	$(addprefix bench.runtime.,restart recorder_throughput recorder_kills replay_bus replay_speed stage_memory)
# compiled modules are kept: hundreds of processes of the tests would each compile them again
unexport PYTHONDONTWRITEBYTECODE
SOURCES := fantwin schemas scoring pipeline simulation stages twin tests bench examples

.PHONY: demo test check selftest compose-test bench schema reference twin lock licences site dist rerun-bump clean
.DEFAULT_GOAL := demo

demo: $(VENV)/.runtime
	$(BIN)/fantwin demo

test: $(VENV)/.development check
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest --numprocesses 4 --dist worksteal

check: $(VENV)/.development
	$(BIN)/ruff format --check $(SOURCES)
	$(BIN)/ruff check $(SOURCES)
	$(BIN)/pyright --threads 2
	$(BIN)/lint-imports

selftest: $(VENV)/.runtime
	$(BIN)/fantwin doctor selftest

# exit code 77 of the first script: it cannot be done here, and it has said why
compose-test: $(VENV)/.development
	@tests/deploy/compose/prepare.sh $(CONTAINERS) $(BIN)/python || { [ $$? = 77 ] && exit 0; exit 1; } && \
		OMP_NUM_THREADS=1 timeout --signal KILL 900 tests/deploy/compose/in_namespaces.sh $(CONTAINERS) \
		$(BIN)/python -m pytest --exitfirst --capture no tests/deploy/compose

bench: $(VENV)/.benches
	for bench in $(BENCHES); do $(BIN)/python -m $$bench || exit 1; done

schema: $(VENV)/.development
	$(BIN)/python -m grpc_tools.protoc -I . --python_out=. --pyi_out=. schemas/fan.proto

reference: $(VENV)/.development
	$(BIN)/python -m fantwin.pipeline.config.reference_page > docs/reference/configuration.md
	$(BIN)/python -m fantwin.pipeline.cli.reference_pages

twin: $(VENV)/.development
	sh pipeline/demo/train_twin.sh $(BIN)/fantwin

lock: $(VENV)/.development
	$(COMPILE) --output-file requirements.lock
	$(COMPILE) --extra devices --extra outputs --constraint requirements.lock \
		--output-file requirements-image.lock
	$(COMPILE) --extra dev --constraint requirements-image.lock --output-file requirements-dev.lock
	@echo "torch; sys_platform == 'none'" > $(VENV)/without-torch.txt
	$(COMPILE) --extra bench --constraint requirements-dev.lock --override $(VENV)/without-torch.txt \
		--output-file requirements-bench.lock
	@echo "install the new versions (make check), then: make licences"

licences: $(VENV)/.development
	$(BIN)/python -m tests.support.licences

# without the variable, mkdocs-material announces MkDocs 2 at each build
site: $(VENV)/.development
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --site-dir build/site

dist: $(VENV)/.development
	$(BIN)/uv build

# what depends on a release of Rerun: its calls, its files, and the viewer itself, which must report nothing
RERUN_TESTS := tests/pipeline/outputs/rerun tests/stages/test_viewer.py \
	tests/pipeline/recordings/test_other_readers.py

rerun-bump:
	@echo "$(VERSION)" | grep -Eqx '[0-9]+\.[0-9]+' || { echo "name a release: make rerun-bump VERSION=0.42"; exit 1; }
	sed -i 's/"rerun-sdk==[^"]*"/"rerun-sdk==$(VERSION).*"/' pyproject.toml
	$(MAKE) lock
	$(MAKE) $(VENV)/.development
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest $(RERUN_TESTS)
	@echo "Rerun $(VERSION) passes; look at the view: rerun runs/demo/view.rrd"

clean:
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .ruff_cache .hypothesis .import_linter_cache
	find $(SOURCES) -name __pycache__ -type d -exec rm -rf {} +

$(VENV)/bin/python:
	@echo "making $(VENV) with $$($(PYTHON) --version)"
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "fantwin needs Python 3.11 or newer; name one: make PYTHON=python3.12 $(MAKECMDGOALS)"; exit 1; }
	@$(PYTHON) -m venv $(VENV)

$(VENV)/.runtime: requirements.lock pyproject.toml | $(VENV)/bin/python
	@echo "installing fantwin and what it runs on into $(VENV), about 460 MB (once)"
	@$(PIP) install --require-hashes -r requirements.lock
	@$(PIP) install --no-deps --editable .
	@touch $@

$(VENV)/.development: requirements-dev.lock pyproject.toml | $(VENV)/.runtime
	@echo "installing what the tests need into $(VENV), the viewer and PyTorch among it (once)"
	@$(PIP) install --require-hashes -r requirements-dev.lock
	@$(PIP) install $(TORCH)
	@$(PIP) check
	@touch $@

$(VENV)/.benches: requirements-bench.lock | $(VENV)/.development
	@echo "installing what the benches race against into $(VENV) (once)"
	@$(PIP) install --require-hashes --no-deps -r requirements-bench.lock
	@touch $@
