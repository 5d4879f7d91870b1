//! Reads an ONNX file: its input, its outputs, the names of its inner values, and its identity.
//!
//! Only those few fields of ONNX's protobuf messages are declared here that are needed.

use std::collections::HashSet;
use std::path::Path;

use prost::Message;
use sha2::{Digest, Sha256};

use super::Error;

#[derive(Clone, PartialEq, Message)]
struct ModelProto {
    #[prost(message, optional, tag = "7")]
    graph: Option<GraphProto>,
}

#[derive(Clone, PartialEq, Message)]
struct GraphProto {
    #[prost(message, repeated, tag = "1")]
    node: Vec<NodeProto>,
    #[prost(message, repeated, tag = "5")]
    initializer: Vec<TensorProto>,
    #[prost(message, repeated, tag = "11")]
    input: Vec<ValueInfoProto>,
    #[prost(message, repeated, tag = "12")]
    output: Vec<ValueInfoProto>,
}

#[derive(Clone, PartialEq, Message)]
struct NodeProto {
    #[prost(string, repeated, tag = "2")]
    output: Vec<String>,
}

#[derive(Clone, PartialEq, Message)]
struct TensorProto {
    #[prost(string, tag = "8")]
    name: String,
    /// 1 if the weights are stored in another file.
    #[prost(int32, tag = "14")]
    location: i32,
}

#[derive(Clone, PartialEq, Message)]
struct ValueInfoProto {
    #[prost(string, tag = "1")]
    name: String,
    #[prost(message, optional, tag = "2")]
    kind: Option<TypeProto>,
}

#[derive(Clone, PartialEq, Message)]
struct TypeProto {
    #[prost(message, optional, tag = "1")]
    tensor: Option<TensorType>,
}

#[derive(Clone, PartialEq, Message)]
struct TensorType {
    /// The type of the elements; 1 is f32.
    #[prost(int32, tag = "1")]
    element: i32,
    #[prost(message, optional, tag = "2")]
    shape: Option<ShapeProto>,
}

#[derive(Clone, PartialEq, Message)]
struct ShapeProto {
    #[prost(message, repeated, tag = "1")]
    dim: Vec<DimProto>,
}

#[derive(Clone, PartialEq, Message)]
struct DimProto {
    #[prost(int64, tag = "1")]
    value: i64,
}

/// The number by which ONNX denotes the element type f32.
const FLOAT: i32 = 1;

/// An ONNX file that was read and checked: it has one input and holds its own weights.
pub(super) struct ModelFile {
    /// The file's name without extension, `@`, and the first 8 bytes of its SHA-256 in hexadecimal.
    pub id: String,
    /// The whole file.
    pub bytes: Vec<u8>,
    /// The shape of its only input; `None` for an axis whose size is open.
    pub input: Vec<Option<usize>>,
    /// The names of its declared outputs.
    pub outputs: Vec<String>,
    /// The names of all values that its nodes compute.
    pub inner: HashSet<String>,
}

impl ModelFile {
    pub fn read(file: &Path) -> Result<Self, Error> {
        let wrong = |problem: String| Error::Model {
            file: file.to_owned(),
            problem,
        };

        let bytes = std::fs::read(file).map_err(|cause| Error::Io {
            file: file.to_owned(),
            cause,
        })?;
        let model = ModelProto::decode(bytes.as_slice());
        let graph = model.ok().and_then(|model| model.graph);
        let graph =
            graph.ok_or_else(|| wrong("is not an ONNX model; is it cut off?".to_owned()))?;

        // The identity is a hash of this file, so it holds only for weights that are in it.
        if graph.initializer.iter().any(|tensor| tensor.location != 0) {
            let inline = "onnx.save(onnx.load(\"FILE.onnx\"), \"WHOLE.onnx\")";
            return Err(wrong(format!(
                "keeps weights in another file; merge them into one file, in Python: {inline}"
            )));
        }

        // A file may list its weights among the inputs; only the other inputs are given by the
        // caller.
        let weights: HashSet<&str> = graph
            .initializer
            .iter()
            .map(|tensor| tensor.name.as_str())
            .collect();
        let inputs: Vec<&ValueInfoProto> = graph
            .input
            .iter()
            .filter(|input| !weights.contains(input.name.as_str()))
            .collect();

        let [input] = inputs.as_slice() else {
            let names: Vec<&str> = inputs.iter().map(|input| input.name.as_str()).collect();
            return Err(wrong(format!(
                "has {} inputs ({}), expected one image",
                names.len(),
                names.join(", ")
            )));
        };

        let tensor = input.kind.as_ref().and_then(|kind| kind.tensor.as_ref());
        if tensor.is_some_and(|tensor| tensor.element != FLOAT) {
            return Err(wrong(
                "has an input that is not float32; export it with an input of float32".to_owned(),
            ));
        }

        // An axis of open size has a name in place of a number, which `DimProto` leaves out: it is
        // read as 0 and becomes `None`.
        let shape = tensor.and_then(|tensor| tensor.shape.as_ref());
        let input = shape.map_or_else(Vec::new, |shape| {
            shape
                .dim
                .iter()
                .map(|dim| usize::try_from(dim.value).ok().filter(|&size| size > 0))
                .collect()
        });

        let outputs = graph.output.into_iter().map(|output| output.name).collect();

        let inner = graph
            .node
            .into_iter()
            .flat_map(|node| node.output)
            .collect();

        Ok(Self {
            id: id_of(file, &bytes),
            bytes,
            input,
            outputs,
            inner,
        })
    }

    /// The size (width, height) of the images that it takes, if the file fixes it.
    pub fn image_size(&self) -> Option<(usize, usize)> {
        match self.input.as_slice() {
            [.., Some(height), Some(width)] if self.input.len() >= 4 => Some((*width, *height)),
            _ => None,
        }
    }

    /// The file with `names` declared as outputs, for a runtime that returns declared outputs only.
    ///
    /// When a protobuf message is written in several parts, a reader merges them. The further
    /// outputs are therefore appended to the file as it is.
    #[cfg_attr(
        not(feature = "onnxruntime"),
        allow(dead_code, reason = "only that runtime needs it")
    )]
    pub fn with_outputs(&self, names: &[String]) -> Vec<u8> {
        let named = |name: &String| ValueInfoProto {
            name: name.clone(),
            kind: None,
        };
        let output = names
            .iter()
            .filter(|name| !self.outputs.contains(name))
            .map(named)
            .collect();

        let more = ModelProto {
            graph: Some(GraphProto {
                output,
                ..GraphProto::default()
            }),
        };

        [self.bytes.as_slice(), &more.encode_to_vec()].concat()
    }
}

/// The identity of a model's file, which is not parsed.
pub(super) fn identity(file: &Path) -> Result<String, Error> {
    let bytes = std::fs::read(file).map_err(|cause| Error::Io {
        file: file.to_owned(),
        cause,
    })?;
    Ok(id_of(file, &bytes))
}

fn id_of(file: &Path, bytes: &[u8]) -> String {
    let stem = file
        .file_stem()
        .map(|stem| stem.to_string_lossy().into_owned())
        .unwrap_or_default();

    let digest: String = Sha256::digest(bytes)
        .iter()
        .take(8)
        .map(|byte| format!("{byte:02x}"))
        .collect();

    format!("{stem}@{digest}")
}
