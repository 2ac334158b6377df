# A farm's programs as images, one target each: worker, learner, recorder.
#
#   docker build --target worker --tag rolloutfarm-worker .
#
# BASE: any image with Python 3.11 or newer and its venv module. UID: the user that the programs run as; files
# that are mounted into them (certificates, tasks) must be readable for this user. PACKAGES: what else pip installs,
# for example "rolloutfarm[gym]", or a package with tasks of your own.
ARG BASE=python:3.11-slim

FROM ${BASE} AS build
WORKDIR /src
COPY constraints.txt pyproject.toml ./
RUN python3 -m venv /opt/build && /opt/build/bin/pip install --quiet --no-cache-dir -c constraints.txt hatchling
# Dependencies first: they are not installed again when only our own files have changed.
RUN python3 -m venv --without-pip /opt/farm \
    && /opt/build/bin/pip --python /opt/farm install --quiet --no-cache-dir -c constraints.txt \
    $(python3 -c "import tomllib; print(*tomllib.load(open('pyproject.toml', 'rb'))['project']['dependencies'])")
COPY README.md LICENSE ./
COPY assets assets
COPY farm farm
COPY workers workers
COPY learner learner
RUN /opt/build/bin/pip wheel --quiet --no-build-isolation --no-deps --wheel-dir /dist . \
    && /opt/build/bin/pip --python /opt/farm install --quiet --no-deps /dist/*.whl
ARG PACKAGES=
RUN test -z "${PACKAGES}" \
    || /opt/build/bin/pip --python /opt/farm install --quiet --no-cache-dir -c constraints.txt ${PACKAGES}

FROM ${BASE} AS program
ARG UID=1000
RUN useradd --uid ${UID} --home-dir /farm --create-home farm \
    && install --directory --owner farm /farm/runs /farm/recordings
USER farm
WORKDIR /farm
ENV PATH=/opt/farm/bin:$PATH PYTHONUNBUFFERED=1
ENTRYPOINT ["farm"]

FROM program AS worker
COPY --from=build /opt/farm /opt/farm
CMD ["worker"]

# The same package: a learner that does not record needs no Rerun.
FROM worker AS learner
CMD ["learner", "--no-record"]

FROM build AS build-recorder
RUN /opt/build/bin/pip --python /opt/farm install --quiet --no-cache-dir -c constraints.txt \
    "$(echo /dist/*.whl)[learner]"

FROM program AS recorder
COPY --from=build-recorder /opt/farm /opt/farm
CMD ["record"]
