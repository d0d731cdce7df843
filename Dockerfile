# docker build -t bayessim-mjx .                        CPU
# docker build -t bayessim-mjx --build-arg ACCEL=cuda . NVIDIA GPU; run it with --gpus all
# docker run --rm -v "$PWD/logs:/runs/logs" bayessim-mjx --task Pendulum
FROM python:3.12-slim

# OSMesa draws videos without a display; git lets runs record the commit that they were made with. No versions are
# pinned: Debian's mirrors keep only the latest ones.
# hadolint ignore=DL3008
RUN apt-get update && apt-get install -y --no-install-recommends git libosmesa6 \
    && rm -rf /var/lib/apt/lists/*

ARG ACCEL=cpu
COPY . /src
RUN if [ "$ACCEL" = cuda ]; then extras="cuda,export,cluster"; else extras="export,cluster"; fi \
    && pip install --no-cache-dir "/src[$extras]" && rm -rf /src

# compiled programs are kept beside the logs
ENV MUJOCO_GL=osmesa BAYESSIM_MJX_CACHE=/runs/.cache
WORKDIR /runs
ENTRYPOINT ["bayessim-mjx"]
CMD ["--help"]
