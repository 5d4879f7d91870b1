"""Tokens by PyJWT: of every algorithm that is taken, and of every kind that is not. Private keys are not kept."""

import base64
import hashlib
import hmac
import json
from pathlib import Path

import cryptography
import jwt
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec, ed25519, rsa

HERE = Path(__file__).parent
ISSUER, AUDIENCE = "https://login.example.org", "seese3"
IN_2100, IN_2001 = 4_102_444_800, 978_307_200

keys = {
    "rsa": rsa.generate_private_key(public_exponent=65537, key_size=2048),
    "p256": ec.generate_private_key(ec.SECP256R1()),
    "p384": ec.generate_private_key(ec.SECP384R1()),
    "ed25519": ed25519.Ed25519PrivateKey.generate(),
}
other = ec.generate_private_key(ec.SECP256R1())


def public_pem(key):
    return key.public_key().public_bytes(
        serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo
    )


def claims(**changed):
    whole = {"iss": ISSUER, "aud": AUDIENCE, "sub": "robot-7", "exp": IN_2100} | changed
    return {name: value for name, value in whole.items() if value is not None}


def signed(content, key=keys["p256"], algorithm="ES256", headers=None):
    # PyJWT checks some claims when it signs; what is wrong on purpose is signed as it is.
    return jwt.api_jws.encode(json.dumps(content).encode(), key, algorithm=algorithm, headers=headers)


for name, key in keys.items():
    (HERE / f"{name}.pem").write_bytes(public_pem(key))

# Keys that are not taken.
unfit = HERE / "unfit"
unfit.mkdir(exist_ok=True)
(unfit / "rsa1024.pem").write_bytes(public_pem(rsa.generate_private_key(public_exponent=65537, key_size=1024)))
(unfit / "p521.pem").write_bytes(public_pem(ec.generate_private_key(ec.SECP521R1())))
(unfit / "two.pem").write_bytes(public_pem(keys["p256"]) + public_pem(keys["p384"]))

good = {
    **{name: signed(claims(), keys["rsa"], name) for name in ["RS256", "RS384", "RS512", "PS256", "PS384", "PS512"]},
    "ES256": signed(claims()),
    "ES384": signed(claims(), keys["p384"], "ES384"),
    "EdDSA": signed(claims(), keys["ed25519"], "EdDSA"),
    "several audiences": signed(claims(aud=["other", AUDIENCE])),
    "expires at a fraction of a second": signed(claims(exp=IN_2100 + 0.5)),
    "good since long ago": signed(claims(nbf=IN_2001)),
}
narrowed = {
    "scope": signed(claims(scope="openid navigate write")),
    "no verb in scope": signed(claims(scope="openid profile")),
    "rooms": signed(claims(seese3_rooms=["lab-2", "kitchen"])),
}
bad = {
    "expired": [signed(claims(exp=IN_2001)), "expired"],
    "not yet good": [signed(claims(nbf=IN_2100)), "not good yet"],
    "for another audience": [signed(claims(aud="other")), "audience"],
    "without audience": [signed(claims(aud=None)), "must have"],
    "without expiry": [signed(claims(exp=None)), "must have"],
    "without subject": [signed(claims(sub=None)), "must have"],
    "without issuer": [signed(claims(iss=None)), "must have"],
    "expiry as text": [signed(claims(exp="2100")), "must have"],
    "beginning as text": [signed(claims(nbf="2001")), "must have"],
    "scope as a list": [signed(claims(scope=["navigate"])), "must have"],
    "empty subject": [signed(claims(sub="")), "sub"],
    "subject of two lines": [signed(claims(sub="a\nb")), "sub"],
    "of another issuer": [signed(claims(iss="https://evil.example.org")), "not known"],
    "of another key": [signed(claims(), other), "not known"],
    "of an extension that has to be understood": [
        signed(claims(), headers={"crit": ["exp-by-moon"], "exp-by-moon": 1}),
        "not known",
    ],
    "of no algorithm": [jwt.encode(claims(), None, algorithm="none"), "not known"],
}


def text(content):
    return base64.urlsafe_b64encode(content).rstrip(b"=").decode()


# The old trick: the public key, which everybody has, as the secret of a symmetric algorithm. PyJWT refuses to sign so.
head = text(json.dumps({"alg": "HS256", "typ": "JWT"}).encode()) + "." + text(json.dumps(claims()).encode())
mac = hmac.new(public_pem(keys["rsa"]), head.encode(), hashlib.sha256).digest()
bad["of the public key as a secret"] = [head + "." + text(mac), "not known"]

written = {
    "made_by": {"pyjwt": jwt.__version__, "cryptography": cryptography.__version__},
    "issuer": ISSUER,
    "audience": AUDIENCE,
    "good": good,
    "narrowed": narrowed,
    "bad": bad,
}
(HERE / "tokens.json").write_text(json.dumps(written, indent=1) + "\n")
