"""The messages and services of the protocol, made from its descriptors.

`descriptors.binpb` is what `buf build` makes of `proto/`. No code is generated, so that any version of protobuf can be
used. The stubs `*_pb2.pyi` are for type checkers and editors.
"""

from __future__ import annotations

import importlib
import sys
from contextlib import suppress
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.internal.enum_type_wrapper import EnumTypeWrapper

# Messages of other packages that the protocol uses: their Python packages register the descriptors.
for _needed in ("google.protobuf.any_pb2", "google.protobuf.timestamp_pb2", "google.rpc.status_pb2"):
    # Without googleapis-common-protos, the descriptors below have what is needed of it.
    with suppress(ImportError):
        importlib.import_module(_needed)

_POOL = descriptor_pool.Default()
_FILES = descriptor_pb2.FileDescriptorSet.FromString((Path(__file__).parent / "descriptors.binpb").read_bytes()).file
_PREFIX = "seese3/v1/"


def _message_class(descriptor: Any) -> Any:
    if hasattr(message_factory, "GetMessageClass"):
        return message_factory.GetMessageClass(descriptor)
    # Versions before 4.22.
    return message_factory.MessageFactory(_POOL).GetPrototype(descriptor)


def _module_of(name: str) -> ModuleType:
    """The module of one proto file: its messages, its enums and the values of these."""
    descriptor = _POOL.FindFileByName(name)
    module = ModuleType(f"{__name__}.{name.removeprefix(_PREFIX).removesuffix('.proto')}_pb2")
    vars(module)["DESCRIPTOR"] = descriptor
    for message, of in descriptor.message_types_by_name.items():
        vars(module)[message] = _message_class(of)
    for enum, of in descriptor.enum_types_by_name.items():
        vars(module)[enum] = EnumTypeWrapper(of)
        vars(module).update({value.name: value.number for value in of.values})
    return module


def _add(name: str, serialized: bytes) -> None:
    """Adds a file to the pool; a program may have made its own stubs of it."""
    try:
        _POOL.FindFileByName(name)
    except KeyError:
        _POOL.AddSerializedFile(serialized)


for _file in _FILES:
    _add(_file.name, _file.SerializeToString())
for _file in _FILES:
    if _file.name.startswith(_PREFIX):
        _made = _module_of(_file.name)
        sys.modules[_made.__name__] = _made
        globals()[_made.__name__.rpartition(".")[2]] = _made


def stub(service: str, channel: Any) -> Any:
    """The methods of a service on a channel, by name. For instance `stub("CatalogService", channel).ListRooms`."""
    descriptor = _POOL.FindServiceByName(f"seese3.v1.{service}")
    proto = descriptor_pb2.ServiceDescriptorProto()
    descriptor.CopyToProto(proto)

    methods = {}
    for method, of in zip(proto.method, descriptor.methods, strict=True):
        kinds = tuple(
            "stream" if is_stream else "unary" for is_stream in (method.client_streaming, method.server_streaming)
        )
        methods[method.name] = getattr(channel, "_".join(kinds))(
            f"/seese3.v1.{service}/{method.name}",
            request_serializer=_message_class(of.input_type).SerializeToString,
            response_deserializer=_message_class(of.output_type).FromString,
        )
    return SimpleNamespace(**methods)
