# One target per stage; `make demo` runs them all on small synthetic captures.
PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready
DATASET ?= build/dataset
# Shells do not expand a quoted ~. Without the test, patsubst would merge spaces within a name.
override DATASET := $(if $(filter ~/%,$(DATASET)),$(HOME)/$(patsubst ~/%,%,$(DATASET)),$(DATASET))
override DATASET := '$(subst ','\'',$(DATASET))'
# Folders with spaces in their names need quotes or backslashes: CAPTURES="'my dir' other".
CAPTURES ?=
PRESET ?= standard
WORKERS ?= 2
SET ?=
SLURM ?=
BUDGET ?= 2h
TRAIN ?= --budget 1h
STAGE_FLAGS = --preset $(PRESET) --workers $(WORKERS) $(foreach kv,$(SET),--set $(kv)) $(if $(SLURM),--slurm $(SLURM))

.PHONY: help setup demo test coverage check bench tradeoff report clean \
        ingest calibrate align frames matte track depth register regions pack run tune train

help: ## list the targets
	@grep -hE '^[a-z -]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*## /\t/' | expand -t 14

setup: $(READY) ## make .venv with everything that is needed
$(READY): pyproject.toml constraints.txt setup.py scripts/system_libs.sh $(wildcard express50/native/*.cpp express50/native/*.h)
	sh scripts/system_libs.sh $(PYTHON)
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --upgrade pip -c constraints.txt
	$(BIN)/python -m pip install --quiet torch -c constraints.txt
	$(BIN)/python -m pip install --quiet -e '.[dev]' -c constraints.txt
	touch $@

demo: $(READY) ## run everything on synthetic captures (or CAPTURES="dir dir ..."): build/demo/report/index.html
	$(BIN)/python -m benchmarks.demo build/demo $(if $(CAPTURES),--captures $(CAPTURES)) --workers $(WORKERS)

PYTEST = $(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder

test: check ## lint, check types, run every test
	$(PYTEST)

coverage: $(READY) ## run every test and print the share of lines that they run; Python code takes 1.4 times as long
	@mkdir -p build
	$(PYTEST) --cov --cov-report=
	@echo "coverage: $$($(BIN)/coverage report --format=total) % of the product's lines"

check: $(READY) ## lint and check types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: $(READY) ## run the benchmarks that need no arguments; each ends with one JSON object
	$(BIN)/python -m benchmarks.all

tradeoff: $(READY) ## measure speed against accuracy and write docs/TRADEOFFS.md
	$(BIN)/python -m benchmarks.tradeoff

ingest: $(READY) ## index CAPTURES="dir ..." into DATASET
	$(BIN)/express50 ingest $(DATASET) $(CAPTURES) $(STAGE_FLAGS)

calibrate align frames matte track depth register regions pack: $(READY) ## run one stage on DATASET
	$(BIN)/express50 $@ $(DATASET) $(STAGE_FLAGS)

run: $(READY) ## run every stage on CAPTURES="dir ..." in DATASET, with settings that fit BUDGET=2h
	$(BIN)/express50 run $(DATASET) $(CAPTURES) --budget $(BUDGET) --workers $(WORKERS) $(foreach kv,$(SET),--set $(kv)) $(if $(SLURM),--slurm $(SLURM))

tune: $(READY) ## measure the error of the whole chain against its time on DATASET
	$(BIN)/express50 tune $(DATASET) $(CAPTURES) --workers $(WORKERS) $(foreach kv,$(SET),--set $(kv)) $(if $(SLURM),--slurm $(SLURM))

train: $(READY) ## train GRMM on DATASET's shards for at most an hour, or continue; the preset suits the machine
	$(BIN)/grmm train $(DATASET)/pack/shards $(DATASET)/grmm $(TRAIN)

report: $(READY) ## write one HTML page of DATASET's results and pictures
	$(BIN)/express50 report $(DATASET)

clean: ## remove what was built, keep .venv and datasets such as build/dataset
	@[ -d express50 ] || { echo "$(CURDIR): is not the repository, nothing is removed" >&2; exit 1; }
	rm -rf .mypy_cache .ruff_cache .pytest_cache
	@for path in build/*; do \
	    if [ -e "$$path/captures.json" ] || \
	        { [ "$$path" = build/demo ] && ls build/demo/data 2>/dev/null | grep -qvx demo; }; \
	    then echo "kept $$path"; else rm -rf "$$path"; fi; \
	done
