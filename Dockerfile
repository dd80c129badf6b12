# The rig's software and the twin, without a clone:
#   docker build --tag sonotwin .
#   docker run --rm --volume "$PWD:/work" --user "$(id -u):$(id -g)" sonotwin demo
# EXTRAS are those of pyproject.toml: `live` for devices; `none` for the rig's software alone; `train` brings gigabytes of PyTorch.
ARG PYTHON=3.11

FROM python:${PYTHON}-slim-bookworm AS build
WORKDIR /source
COPY . .
RUN python -m pip wheel --no-cache-dir --no-deps --wheel-dir /wheels .

FROM python:${PYTHON}-slim-bookworm
ARG EXTRAS=twin,study
# LLVM is what the renderer compiles with
RUN apt-get update \
    && apt-get install --yes --no-install-recommends libllvm19=1:19.* \
    && rm -rf /var/lib/apt/lists/* \
    && useradd --uid 10001 --create-home rig
COPY constraints.txt /tmp/constraints.txt
RUN --mount=type=bind,from=build,source=/wheels,target=/wheels \
    wheel=$(echo /wheels/*.whl) \
    && if [ "$EXTRAS" != none ]; then wheel="${wheel}[$EXTRAS]"; fi \
    && python -m pip install --no-cache-dir --constraint /tmp/constraints.txt "$wheel"
# places that whoever the container runs as can write
ENV SONOTWIN_CACHE=/tmp/sonotwin MPLCONFIGDIR=/tmp/matplotlib
USER 10001
WORKDIR /work
ENTRYPOINT ["sonotwin"]
CMD ["--help"]
