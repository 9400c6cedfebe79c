# make run and make test, in a container:
#   docker build --tag ls3 .
#   docker run --volume "$PWD/runs:/ls3-torchrl/runs" ls3              # trains on Navigation; pictures land in ./runs
#   docker run ls3 make test
FROM python:3.11-slim
RUN apt-get update \
    && apt-get install --yes --no-install-recommends git make \
    && rm -rf /var/lib/apt/lists/*
WORKDIR /ls3-torchrl
COPY . .
RUN make .venv/test.installed
CMD ["make", "run"]
