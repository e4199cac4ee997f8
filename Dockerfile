# The core with labels and dense maps, on the CPU:  docker build --tag bmask-slam .
FROM python:3.11-slim AS build
ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
RUN python -m venv /opt/bmask-slam
ENV PATH=/opt/bmask-slam/bin:$PATH
COPY constraints.txt /tmp/constraints.txt
RUN pip install --constraint /tmp/constraints.txt --index-url https://download.pytorch.org/whl/cpu \
    --extra-index-url https://pypi.org/simple torch
COPY . /src
RUN pip install --constraint /tmp/constraints.txt --no-compile '/src[semantics,dense]'

FROM python:3.11-slim
RUN useradd --create-home slam
COPY --from=build /opt/bmask-slam /opt/bmask-slam
ENV PATH=/opt/bmask-slam/bin:$PATH
USER slam
WORKDIR /home/slam
ENTRYPOINT ["bmask-slam"]
CMD ["--help"]
