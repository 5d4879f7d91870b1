//! Reads an ONNX file: its input, its outputs, the names of its inner values, and its identity.
//!
//! - Only the needed fields of ONNX's protobuf messages are declared here.
//! - Weights may be in other files of the same folder, as `torch.onnx.export` writes them. The
//!   identity covers them too: the same graph with other weights is another encoder.

use seese3_core::Cause;
use std::collections::{BTreeSet, HashSet};
use std::path::{Component, Path};

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
    #[prost(message, repeated, tag = "5")]
    attribute: Vec<AttributeProto>,
}

#[derive(Clone, PartialEq, Message)]
struct AttributeProto {
    #[prost(message, optional, tag = "5")]
    tensor: Option<TensorProto>,
    /// The branches and bodies of If, Loop and Scan.
    #[prost(message, optional, boxed, tag = "6")]
    graph: Option<Box<GraphProto>>,
    #[prost(message, repeated, tag = "10")]
    tensors: Vec<TensorProto>,
    #[prost(message, repeated, tag = "11")]
    graphs: Vec<GraphProto>,
}

#[derive(Clone, PartialEq, Message)]
struct TensorProto {
    #[prost(string, tag = "8")]
    name: String,
    /// The position of the numbers in another file; the entry `location` is that file's name.
    #[prost(message, repeated, tag = "13")]
    external: Vec<EntryProto>,
    /// 1 if the weights are stored in another file.
    #[prost(int32, tag = "14")]
    location: i32,
}

#[derive(Clone, PartialEq, Message)]
struct EntryProto {
    #[prost(string, tag = "1")]
    key: String,
    #[prost(string, tag = "2")]
    value: String,
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

/// ONNX's code for the element type f32.
const FLOAT: i32 = 1;

/// A checked ONNX file: it has one input, and its weight files can be read.
pub(super) struct ModelFile {
    /// The file's name without extension, `@`, and the first 8 bytes, in hexadecimal, of the
    /// SHA-256 of the file and its weight files.
    pub id: String,
    /// The whole file.
    pub bytes: Vec<u8>,
    /// The shape of its only input; `None` for a dynamic axis.
    pub input: Vec<Option<usize>>,
    /// The names of its declared outputs.
    pub outputs: Vec<String>,
    /// The names of all values that its nodes compute.
    pub inner: HashSet<String>,
}

impl ModelFile {
    pub fn read(file: &Path) -> Result<Self, Error> {
        let wrong = |problem: Cause| Error::Model {
            file: file.to_owned(),
            problem,
        };

        let (bytes, graph) = read_graph(file)?;
        let id = id_of(file, &bytes, &graph)?;

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
            return Err(wrong(
                format!(
                    "has {} inputs ({}), expected one image",
                    names.len(),
                    names.join(", ")
                )
                .into(),
            ));
        };

        let tensor = input.kind.as_ref().and_then(|kind| kind.tensor.as_ref());
        if tensor.is_some_and(|tensor| tensor.element != FLOAT) {
            return Err(wrong(
                "has an input that is not float32; export it with an input of float32".into(),
            ));
        }

        // A dynamic axis has a name instead of a number. `DimProto` does not declare it, so the
        // size is read as 0 and becomes `None`.
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
            id,
            bytes,
            input,
            outputs,
            inner,
        })
    }

    /// The size (width, height) of its input images, if the file fixes it.
    pub fn image_size(&self) -> Option<(usize, usize)> {
        match self.input.as_slice() {
            [.., Some(height), Some(width)] if self.input.len() >= 4 => Some((*width, *height)),
            _ => None,
        }
    }

    /// The file with `names` declared as outputs, for a runtime that returns declared outputs only.
    ///
    /// Protobuf readers merge concatenated messages, so the additional outputs are appended to the
    /// unchanged file.
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

/// The identity of a model.
pub(super) fn identity(file: &Path) -> Result<String, Error> {
    let (bytes, graph) = read_graph(file)?;
    id_of(file, &bytes, &graph)
}

/// Maximum size of a model file, bytes: the limit of a protocol buffer.
const MAX_MODEL_BYTES: u64 = 2 << 30;

fn read_graph(file: &Path) -> Result<(Vec<u8>, GraphProto), Error> {
    let bytes = seese3_files::read(file, MAX_MODEL_BYTES).map_err(|cause| Error::Io {
        file: file.to_owned(),
        cause,
    })?;
    let model = ModelProto::decode(bytes.as_slice());
    let graph = model.ok().and_then(|model| model.graph);
    let graph = graph.ok_or_else(|| Error::Model {
        file: file.to_owned(),
        problem: "is not an ONNX model; is it truncated?".into(),
    })?;

    Ok((bytes, graph))
}

/// Adds the names of the external files with the weights of a graph and its subgraphs.
fn add_weight_files<'a>(graph: &'a GraphProto, names: &mut BTreeSet<&'a str>) {
    add_external(&graph.initializer, names);
    for attribute in graph.node.iter().flat_map(|node| &node.attribute) {
        add_external(&attribute.tensor, names);
        add_external(&attribute.tensors, names);
        for graph in attribute
            .graph
            .iter()
            .map(AsRef::as_ref)
            .chain(&attribute.graphs)
        {
            add_weight_files(graph, names);
        }
    }
}

fn add_external<'a>(
    tensors: impl IntoIterator<Item = &'a TensorProto>,
    names: &mut BTreeSet<&'a str>,
) {
    let outside = tensors.into_iter().filter(|tensor| tensor.location != 0);
    let entries = outside.flat_map(|tensor| &tensor.external);
    let locations = entries.filter(|entry| entry.key == "location");
    names.extend(locations.map(|entry| entry.value.as_str()));
}

/// The file's name and a digest of the model and its weights.
fn id_of(file: &Path, bytes: &[u8], graph: &GraphProto) -> Result<String, Error> {
    let stem = file
        .file_stem()
        .map(|stem| stem.to_string_lossy().into_owned())
        .unwrap_or_default();

    let mut digest = Sha256::new();
    digest.update(bytes);
    let mut names = BTreeSet::new();
    add_weight_files(graph, &mut names);
    for name in names {
        let wrong = |problem: Cause| Error::Model {
            file: file.to_owned(),
            problem,
        };

        // An untrusted model must not make this program read files outside its folder.
        let is_beside = Path::new(name)
            .components()
            .all(|part| matches!(part, Component::Normal(_) | Component::CurDir));
        if !is_beside {
            return Err(wrong(format!(
                "keeps weights in '{name}', which does not lie in the model's folder; move it there and \
                 export again"
            ).into()));
        }

        let weights = file.parent().unwrap_or(Path::new("")).join(name);
        let mut weights =
            seese3_files::open(&weights).map_err(|cause| {
                wrong(format!(
                "keeps weights in {}, which cannot be read: {cause}; copy it beside the model",
                weights.display()
            ).into())
            })?;
        std::io::copy(&mut weights, &mut digest).map_err(|cause| Error::Io {
            file: file.to_owned(),
            cause,
        })?;
    }

    let digest: String = digest
        .finalize()
        .iter()
        .take(8)
        .map(|byte| format!("{byte:02x}"))
        .collect();
    Ok(format!("{stem}@{digest}"))
}
