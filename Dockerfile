# The static program and nothing else. The build context has it as amd64/ckpt-doctor or arm64/ckpt-doctor:
#
#     docker build --file Dockerfile --tag ckpt-doctor CONTEXT
#     docker run --rm --volume "$PWD:/data:ro" ckpt-doctor check models
FROM scratch
ARG TARGETARCH=amd64
COPY ${TARGETARCH}/ckpt-doctor /ckpt-doctor
WORKDIR /data
ENTRYPOINT ["/ckpt-doctor"]
CMD ["--help"]
