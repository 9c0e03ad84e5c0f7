# The service in a container, without root.
#
#   docker build --tag deep-simbad .
#   docker run --rm --volume deep-simbad:/var/lib/deepsimbad deep-simbad keys create --scope admin
#   docker run --detach --stop-timeout 30 --publish 127.0.0.1:8000:8000 --volume deep-simbad:/var/lib/deepsimbad deep-simbad
#
# It listens on every address of its network, so it refuses to start until the first key was created. Any command of
# `deepsimbad` can stand in the place of `keys create ...`. Stopping it lets requests under way finish, and a job record
# where it stands: hence the timeout, longer than Docker's own ten seconds.
#
# It computes on the processor: PyTorch comes from PyTorch's own index of CPU builds, about 1.8 GB of image in all, and
# ONNX Runtime runs the default extractor. With a GPU,
#
#   docker build --build-arg VARIANT=cuda --build-arg PIP_EXTRA_INDEX_URL= --tag deep-simbad:cuda .
#
# builds on NVIDIA's CUDA base with PyPI's PyTorch, which brings CUDA's libraries, about 8 GB.
#
# Packages are held to the digests in deploy/requirements-*.txt, base images to those beside their tags. A newer base, with
# Debian's latest fixes, is `--build-arg PYTHON_IMAGE=python:3.11-slim-bookworm@sha256:...`, by the digest that
# `docker buildx imagetools inspect python:3.11-slim-bookworm` tells.
ARG VARIANT=cpu
ARG PYTHON_IMAGE=python:3.11-slim-bookworm@sha256:a36c24f9cbdf4fd0f52d67f0823eeac19c2028c637cecc392d97f980d4fec56b
ARG CUDA_IMAGE=nvidia/cuda:12.8.1-base-ubuntu24.04@sha256:133c78a0575303be34164d0b90137a042172bdf60696af01a3c424ab402d86e2

# hadolint ignore=DL3006
FROM ${PYTHON_IMAGE} AS base-cpu

# hadolint ignore=DL3006
FROM ${CUDA_IMAGE} AS base-cuda
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install --yes --no-install-recommends python3 python3-venv \
    && rm -rf /var/lib/apt/lists/*

# hadolint ignore=DL3006
FROM base-${VARIANT} AS build
ARG VARIANT=cpu
ARG PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu
ENV PIP_NO_CACHE_DIR=1 \
    PIP_DISABLE_PIP_VERSION_CHECK=1
WORKDIR /src
COPY deploy deploy
RUN python3 -m venv /opt/deepsimbad \
    && /opt/deepsimbad/bin/python -m pip install --require-hashes --requirement deploy/requirements-${VARIANT}.txt \
    && python3 -m venv --without-pip /src/build \
    && /opt/deepsimbad/bin/python -m pip --python /src/build install --require-hashes --requirement deploy/requirements-build.txt
COPY pyproject.toml README.md CHANGELOG.md LICENSE ./
COPY service service
COPY client client
COPY migrations migrations
RUN /opt/deepsimbad/bin/python -m pip --python /src/build wheel --no-deps --no-build-isolation --wheel-dir /src/wheel . \
    && /opt/deepsimbad/bin/python -m pip install --no-deps /src/wheel/*.whl \
    && /opt/deepsimbad/bin/python -m pip uninstall --yes --quiet pip setuptools
# The hot loops are compiled, and the default network is made ready, here rather than in front of the first robot. numba
# takes its loops for the same kind of processor alone; on another kind it compiles anew, into the volume.
RUN install -d -m 0700 /var/lib/deepsimbad/data /var/lib/deepsimbad/cache /var/lib/deepsimbad/weights \
    && NUMBA_CACHE_DIR=/var/lib/deepsimbad/cache DEEPSIMBAD_WEIGHTS_DIR=/var/lib/deepsimbad/weights \
       /opt/deepsimbad/bin/python -c "from deepsimbad.engine.localizer import warm_up; from deepsimbad.engine.worker import EvaluatorPool; from deepsimbad.settings import Settings; warm_up(); EvaluatorPool(Settings().compute()).evaluator({'kind': 'feature_l2'}).load()"

# hadolint ignore=DL3006
FROM base-${VARIANT} AS service
ARG VERSION=0.1.0
LABEL org.opencontainers.image.title="Deep SIMBAD" \
      org.opencontainers.image.description="Active visual self-localization as a service" \
      org.opencontainers.image.version="${VERSION}" \
      org.opencontainers.image.licenses="MIT" \
      org.opencontainers.image.documentation="docs/operations.md"
COPY --from=build /opt/deepsimbad /opt/deepsimbad
COPY --from=build --chown=10001:10001 /var/lib/deepsimbad /var/lib/deepsimbad
ENV PATH=/opt/deepsimbad/bin:$PATH \
    HOME=/var/lib/deepsimbad \
    PYTHONUNBUFFERED=1 \
    PYTHONDONTWRITEBYTECODE=1 \
    NUMBA_CACHE_DIR=/var/lib/deepsimbad/cache \
    DEEPSIMBAD_DATA_DIR=/var/lib/deepsimbad/data \
    DEEPSIMBAD_WEIGHTS_DIR=/var/lib/deepsimbad/weights \
    DEEPSIMBAD_HOST=0.0.0.0 \
    DEEPSIMBAD_PORT=8000
USER 10001:10001
WORKDIR /var/lib/deepsimbad
VOLUME /var/lib/deepsimbad
EXPOSE 8000
# Plain HTTP: where the service itself speaks TLS, give `docker run` another --health-cmd.
HEALTHCHECK --interval=15s --timeout=5s --start-period=60s --retries=3 \
    CMD ["/opt/deepsimbad/bin/python", "-c", "import os, urllib.request as r; r.urlopen('http://127.0.0.1:' + os.environ['DEEPSIMBAD_PORT'] + '/readyz', timeout=4)"]
ENTRYPOINT ["/opt/deepsimbad/bin/deepsimbad"]
CMD ["serve"]
