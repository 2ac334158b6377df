"""Why an endpoint does not answer: Zenoh gives one reason for a closed port, a wrong authority and
a wrong host name.

The probe connects and shakes hands as Zenoh does, by the standard library, which says more.
"""

import socket
import ssl
from typing import Final

from farm.net.tls import Bundle

_SECONDS: Final = 2.0  # for each step
_PLAIN: Final = (
    "what listens there has no certificates: --connect tcp/{0} without --tls, or start the learner"
    " with --listen tls/0.0.0.0:{1} --tls CERTS/learner"
)
_ENCRYPTED: Final = (
    "what listens there wants certificates: --connect tls/{0} --tls FOLDER, this machine's folder"
    " that farm certificates made (worker-NAME)"
)
_EXPIRED: Final = 10  # OpenSSL's X509_V_ERR_CERT_HAS_EXPIRED
_NAMES: Final = (62, 64)  # its X509_V_ERR_HOSTNAME_MISMATCH and _IP_ADDRESS_MISMATCH
_PURPOSE: Final = 26  # its X509_V_ERR_INVALID_PURPOSE


def reason(endpoint: str, bundle: Bundle | None = None) -> str:
    """Why there is no answer, and the remedy; empty if this probe gets through as well."""
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    host = host.strip("[]")
    try:
        with socket.create_connection((host, int(port)), _SECONDS) as link:
            problem = _unencrypted(link) if bundle is None else _handshake(link, host, bundle)
            if problem in (_PLAIN, _ENCRYPTED):
                return problem.format(endpoint.partition("/")[2], port)
            return problem
    except ConnectionRefusedError:
        return (
            f"nothing listens on port {port} of {host}; start a learner there (it listens after its"
            " pilot), or check --connect"
        )
    except socket.gaierror:
        return f"the host name {host} is unknown here; check --connect"
    except OSError as error:
        why = "it takes too long" if isinstance(error, TimeoutError) else error.strerror or error
        return (
            f"{host} cannot be reached at port {port} ({why}); is it on, and does a firewall let"
            " the port through?"
        )


def _unencrypted(link: socket.socket) -> str:
    """Begin a handshake of TLS: a listener without certificates closes the connection, or says
    nothing.
    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE  # whoever it is
    try:
        with context.wrap_socket(link):
            return _ENCRYPTED
    except ssl.SSLError as error:
        return _ENCRYPTED if "ALERT" in (error.reason or "") else ""
    except OSError:
        return ""


def _handshake(link: socket.socket, host: str, bundle: Bundle) -> str:
    """Shake hands.

    Then read, because a listener's refusal of our certificate comes after the handshake (TLS 1.3).
    """
    context = ssl.create_default_context(cafile=bundle.folder / "ca.pem")
    context.load_cert_chain(bundle.folder / "cert.pem", bundle.folder / "key.pem")
    done = False
    try:
        with context.wrap_socket(link, server_hostname=host) as secured:
            done = True
            secured.recv(1)
    except TimeoutError:
        return "" if done else _PLAIN  # after the handshake it waits for our first message
    except ssl.SSLCertVerificationError as error:
        return _distrust(error, host, bundle)
    except ssl.SSLError as error:
        return _refusal(error.reason or "", bundle)
    except OSError:
        return _PLAIN
    return ""


def _distrust(error: ssl.SSLCertVerificationError, host: str, bundle: Bundle) -> str:
    if error.verify_code in _NAMES:
        return (
            f"its certificate is not for the host name {host}; connect by a name that farm"
            " certificates was given with --learner, or add this one: farm certificates renew"
            f" CERTS --learner {host}"
        )
    if error.verify_code == _EXPIRED:
        return "the learner's certificate has expired; farm certificates renew CERTS replaces it"
    if error.verify_code == _PURPOSE:
        return "its certificate is not a learner's; listen with --tls CERTS/learner"
    return (
        f"its certificate is of another authority than {bundle.folder / 'ca.pem'}; use one"
        " authority's certificates"
    )


def _refusal(alert: str, bundle: Bundle) -> str:
    """Meaning of a listener's alert; the names of alerts are OpenSSL's."""
    ours = f"it refuses the certificate of {bundle.role} {bundle.name} in {bundle.folder}"
    if "EXPIRED" in alert:
        return f"{ours}: expired; farm certificates renew CERTS replaces it"
    if "UNKNOWN_CA" in alert:
        return f"{ours}: of another authority than the listener's; use one authority's certificates"
    if "ALERT" in alert:
        return f"{ours} ({alert.replace('_', ' ').lower()}); same authority, still valid?"
    return _PLAIN
