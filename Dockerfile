# docker build -t dynapix . && docker run -it -v "$PWD/store:/dynapix/store" dynapix python -m dynapix
# For a GPU, add --gpus all: the torch of the registry has CUDA.
FROM python:3.11-slim

# pybullet has wheels for Python 3.11; other packages may need a compiler.
RUN apt-get update && apt-get install --yes --no-install-recommends build-essential git make \
    && rm -rf /var/lib/apt/lists/*

WORKDIR /dynapix
# The dependencies change seldom, so they are a layer of their own.
COPY pyproject.toml constraints.txt README.md Makefile ./
COPY dynapix/__init__.py dynapix/__init__.py
RUN make setup PYTHON=python3.11
ENV PATH=/dynapix/.venv/bin:$PATH

COPY . .
CMD ["python", "-m", "dynapix"]
