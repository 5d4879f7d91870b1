"""The connection to the server: TLS and a token."""

from pathlib import Path

import grpc

# A link that is gone is noticed by pings.
KEEPALIVE = [("grpc.keepalive_time_ms", 20_000), ("grpc.keepalive_timeout_ms", 10_000)]


def channel(given):
    """A channel by the parameters `server`, `tls_ca`, `tls_cert` and `tls_key`.

    Raises ValueError for a certificate without its key, and OSError for a file that cannot be read."""
    if bool(given["tls_cert"]) != bool(given["tls_key"]):
        raise ValueError("tls_cert and tls_key belong together: give both or neither")
    if not given["tls_ca"]:
        if given["tls_cert"] or given["token_file"]:
            raise ValueError("tls_ca is needed: a token or a certificate is only sent over TLS")
        return grpc.insecure_channel(given["server"], KEEPALIVE)

    files = [Path(given[name]).read_bytes() if given[name] else None for name in ("tls_ca", "tls_key", "tls_cert")]
    return grpc.secure_channel(given["server"], grpc.ssl_channel_credentials(*files), KEEPALIVE)


def metadata(given):
    """What is sent with every call: the token of `token_file`.

    Raises OSError for a file that cannot be read."""
    if not given["token_file"]:
        return ()
    token = Path(given["token_file"]).read_text().strip()
    return (("authorization", f"Bearer {token}"),)
