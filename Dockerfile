# One image for every stage; which stage a container runs is its command.
FROM python:3.11-slim-bookworm
WORKDIR /app
COPY requirements-image.lock ./
RUN pip install --no-cache-dir --require-hashes -r requirements-image.lock
COPY pyproject.toml README.md LICENSE ./
COPY fantwin fantwin
COPY schemas schemas
COPY scoring scoring
COPY pipeline pipeline
COPY stages stages
COPY simulation simulation
COPY twin twin
RUN pip install --no-cache-dir --no-deps . && useradd --create-home --uid 1000 fantwin \
    && mkdir -p /runs /authority /certs \
    && python -c "from fantwin.pipeline.config.registry import STAGES; print('router operator', *STAGES)" \
    | xargs -n 1 | xargs -I{} mkdir -p /certs-of/{} && chown -R fantwin /runs /authority /certs /certs-of
COPY pipeline/demo /demo
# without this, ONNX Runtime sends usage reports to its maker; caches go where a read-only container may write
ENV ORT_DISABLE_TELEMETRY=1 MPLCONFIGDIR=/tmp/matplotlib
USER fantwin
WORKDIR /runs
ENTRYPOINT ["fantwin"]
