# Lookalike with Mesa's software Vulkan driver (lavapipe) inside: needs no graphics card.
#
#     docker build -t lookalike .
#     docker run --rm --network host -v lookalike:/var/lib/lookalike lookalike
#
# The server refuses any address but loopback without TLS and authentication, and the loopback of a container
# is its own: publishing ports (`-p 7420:7420`) reaches nothing. It is reached
#   - from the host, with `--network host` as above: the container then shares the host's loopback;
#   - from a container that shares its network (`--network container:NAME`), such as a proxy that
#     authenticates;
#   - by `docker exec NAME lookalike jobs`.

FROM rust:1.95-bookworm AS build
WORKDIR /src
# What .dockerignore lets through.
COPY . .
# Dependencies and what was built of them are kept from build to build (BuildKit, the default since Docker
# 23). Our own sources count as new, whatever times they carry. Names of functions stay in the program, for
# the texts of panics.
RUN --mount=type=cache,target=/usr/local/cargo/registry \
    --mount=type=cache,target=/src/target \
    find src proto -type f -exec touch {} + \
    && cargo build --release --locked --bin lookalike \
    && strip --strip-debug -o /lookalike target/release/lookalike

FROM debian:bookworm-slim
RUN apt-get update \
    && apt-get install --yes --no-install-recommends ca-certificates libvulkan1 mesa-vulkan-drivers \
    && rm -r /var/lib/apt/lists/* \
    && useradd --uid 7420 --no-create-home --home-dir /var/lib/lookalike --shell /usr/sbin/nologin lookalike \
    # A new volume takes over owner and mode of what the image has there.
    && install --directory --owner lookalike --mode 0700 /var/lib/lookalike \
        /var/lib/lookalike/data /var/lib/lookalike/shaders /run/lookalike
COPY --from=build /lookalike /usr/local/bin/lookalike
USER lookalike
WORKDIR /var/lib/lookalike
VOLUME /var/lib/lookalike
# Mesa wants a private folder of its own, and keeps compiled shaders: on the volume, they are compiled once.
# Large meshes lie in large pages: their geometric stage takes about a tenth less time.
ENV GLIBC_TUNABLES=glibc.malloc.hugetlb=1 \
    XDG_RUNTIME_DIR=/run/lookalike \
    MESA_SHADER_CACHE_DIR=/var/lib/lookalike/shaders \
    LOOKALIKE_DATA_DIR=/var/lib/lookalike/data \
    LOOKALIKE_LISTEN=127.0.0.1:7420 \
    LOOKALIKE_METRICS_LISTEN=127.0.0.1:7421 \
    LOOKALIKE_SERVER=http://127.0.0.1:7420
# gRPC; Prometheus metrics and health.
EXPOSE 7420 7421
# Asks the server for its jobs, and so asks the store behind it.
HEALTHCHECK --interval=15s --timeout=5s --start-period=10s --retries=3 \
    CMD ["lookalike", "jobs", "--limit=1"]
# Time for workers to hand their jobs back: 10 s by default (LOOKALIKE_DRAIN_SECS), and some for the rest.
STOPSIGNAL SIGTERM
ENTRYPOINT ["lookalike"]
CMD ["serve"]
