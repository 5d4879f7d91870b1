//! Errors as gRPC statuses. This is the only place where status codes are chosen.

use prost::Message;
use strum::{Display, IntoStaticStr, VariantArray};
use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt};

use seese3_core::room::FrameId;
use seese3_core::{adapter, cancel, eval, navigation, room, splits};

/// The longest name of a room or an adapter, bytes.
const LONGEST_NAME: usize = 100;

/// Minimum similarity, 0 to 1, for suggesting a served name: one wrong letter in four.
const NEARLY: f64 = 0.75;

/// Domain of the error reasons (`google.rpc.ErrorInfo.domain`).
const DOMAIN: &str = "seese3.v1";

/// A limit that refuses requests when it is reached.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Display, IntoStaticStr, VariantArray)]
#[strum(serialize_all = "lowercase")]
pub enum Full {
    /// The lane of short requests.
    #[strum(serialize = "short requests")]
    ShortRequests,
    /// The lane of requests with images.
    #[strum(serialize = "requests with images")]
    Images,
    /// The lane of batches and other long requests.
    #[strum(serialize = "batches and long requests")]
    LongRequests,
    /// The lane of evaluations.
    #[strum(serialize = "evaluations")]
    Evaluations,
    /// The queued requests of one caller.
    #[strum(serialize = "queued requests of this caller")]
    CallersQueue,
    /// The server's Track streams.
    #[strum(serialize = "Track streams")]
    Streams,
    /// The Track streams of one caller.
    #[strum(serialize = "Track streams of this caller")]
    CallersStreams,
    /// The requests and streams of one caller.
    #[strum(serialize = "requests of this caller")]
    CallersRequests,
    /// The connections. A refused connection is closed without an error message.
    Connections,
    /// The connections of one caller, while others need theirs.
    #[strum(serialize = "connections of this caller, which can share one")]
    CallersConnections,
    /// The bytes of all uploads in progress.
    #[strum(serialize = "bytes of uploads")]
    Uploads,
    /// One caller's share of the bytes of uploads.
    #[strum(serialize = "bytes of uploads of this caller")]
    CallersUploads,
    /// The lane of fits.
    Fits,
    /// The requests that wait for rooms or images to be read, or one caller's share of them.
    #[strum(serialize = "requests that wait for the disk")]
    DiskReads,
    /// The fits of one caller; only one is queued or runs at a time.
    #[strum(serialize = "fits of this caller")]
    CallersFits,
    /// The memory of requests in progress.
    #[strum(serialize = "bytes of requests")]
    Memory,
    /// One caller's share of the memory of requests.
    #[strum(serialize = "bytes of requests of this caller")]
    CallersMemory,
    /// The health calls of a connection.
    #[strum(serialize = "health calls of this connection")]
    HealthCalls,
    /// The queued changes of the catalog.
    Changes,
    /// The queued changes of one caller.
    #[strum(serialize = "changes of this caller")]
    CallersChanges,
}

/// A resource that is not there, or that should not be (`google.rpc.ResourceInfo`).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Missing {
    /// Its kind: room, adapter, revision or frame.
    pub kind: &'static str,
    /// Its name.
    pub name: String,
}

impl Missing {
    /// A resource of this kind and name.
    pub fn of(kind: &'static str, name: impl Into<String>) -> Self {
        Self {
            kind,
            name: name.into(),
        }
    }
}

/// An error of a request. Its name is the reason in `google.rpc.ErrorInfo`.
#[derive(Debug, Clone, thiserror::Error, PartialEq, IntoStaticStr)]
#[strum(serialize_all = "SCREAMING_SNAKE_CASE")]
#[allow(missing_docs, reason = "each variant's message says what it is")]
pub enum Error {
    #[error("{field}: {problem}")]
    #[strum(serialize = "INVALID_FIELD")]
    Invalid { field: String, problem: String },
    #[error("{field}: {problem}")]
    #[strum(serialize = "NOT_SERVED")]
    NotFound {
        field: String,
        missing: Missing,
        problem: String,
    },
    #[error("{field}: {problem}")]
    NotStored {
        field: String,
        missing: Missing,
        problem: String,
    },
    #[error("{0}")]
    Precondition(String),
    #[error("the server is not ready: it is loading its store or stopping; try again")]
    #[strum(serialize = "NOT_READY")]
    Loading,
    #[error("the server is busy: the limit of {what} is reached; try again later")]
    #[strum(serialize = "BUSY")]
    Full { what: Full },
    #[error("{field}: {problem}")]
    #[strum(serialize = "ALREADY_EXISTS")]
    Exists {
        field: String,
        there: Missing,
        problem: String,
    },
    #[error("{problem}")]
    Quota { problem: String },
    #[error("this server has no such RPC")]
    #[strum(serialize = "UNKNOWN_RPC")]
    UnknownPath,
    #[error("{problem}")]
    Unauthenticated { problem: &'static str },
    #[error("{name}: {problem}")]
    Conflict { name: String, problem: String },
    #[error("the request could not be received: {problem}")]
    Transport { code: Code, problem: String },
    #[error("the caller lacks the verb '{verb}'; the operator grants it in --auth-file")]
    Forbidden { verb: &'static str },
    #[error("the caller may not change {what}; its rooms are listed in --auth-file")]
    OutOfScope { what: &'static str },
    #[error("the deadline passed before the answer was ready")]
    Deadline,
    #[error("the request was cancelled")]
    Cancelled,
    #[error("internal error; the server's log has the cause under the request id")]
    Internal,
}

impl Error {
    /// An error in the request field `field`.
    pub fn invalid(field: impl Into<String>, problem: impl ToString) -> Self {
        Self::Invalid {
            field: field.into(),
            problem: problem.to_string(),
        }
    }

    /// An error for a name that is not among the `served` names.
    pub fn not_found<'a>(
        field: &str,
        name: &str,
        served: impl IntoIterator<Item = &'a String>,
    ) -> Self {
        // The comparison takes time in proportion to the length, and the answer repeats the name.
        let is_long = name.len() > LONGEST_NAME;
        let shown: String = name.chars().take(LONGEST_NAME).collect();
        let name = shown.as_str();
        let likeness = |served: &String| strsim::normalized_damerau_levenshtein(served, name);
        let nearest = served
            .into_iter()
            .filter(|_| !is_long)
            .map(|served| (likeness(served), served))
            .filter(|(likeness, _)| *likeness >= NEARLY)
            .max_by(|a, b| a.0.total_cmp(&b.0));

        let kind = if field.contains("adapter") {
            "adapter"
        } else {
            "room"
        };
        let remedy = match (name.split_once('/'), nearest) {
            (Some(("rooms" | "adapters", own)), _) => format!("; send the name alone, '{own}'"),
            (_, Some((_, nearest))) => format!("; did you mean '{nearest}'?"),
            (_, None) => String::new(),
        };
        Self::NotFound {
            field: field.to_owned(),
            missing: Missing::of(kind, name),
            problem: match is_long {
                true => format!("'{name}…' is not served; names have at most {LONGEST_NAME} bytes"),
                false => format!("'{name}' is not served{remedy}"),
            },
        }
    }

    /// An error for a frame that the room does not have.
    pub fn no_frame(field: &str, frame: FrameId, frame_count: usize) -> Self {
        let last = frame_count.saturating_sub(1);
        Self::NotFound {
            field: field.to_owned(),
            missing: Missing::of("frame", frame.to_string()),
            problem: format!("the room has no frame {frame}; its frames are 0 to {last}"),
        }
    }

    /// An error for a revision that the store does not have.
    pub fn no_revision(field: &str, name: &str, revision: u64) -> Self {
        let remedy = match revision {
            0 => "; revisions are counted from 1",
            _ => "",
        };
        Self::NotFound {
            field: field.to_owned(),
            missing: Missing::of("revision", format!("{name}/revisions/{revision}")),
            problem: format!("'{name}' has no revision {revision}{remedy}"),
        }
    }

    /// The same error with its field prefixed by the field that contains it.
    pub fn within(self, parent: &str) -> Self {
        match self {
            Self::Invalid { field, problem } => Self::Invalid {
                field: format!("{parent}.{field}"),
                problem,
            },
            Self::NotFound {
                field,
                missing,
                problem,
            } => Self::NotFound {
                field: format!("{parent}.{field}"),
                missing,
                problem,
            },
            Self::NotStored {
                field,
                missing,
                problem,
            } => Self::NotStored {
                field: format!("{parent}.{field}"),
                missing,
                problem,
            },
            other => other,
        }
    }

    /// The same error; if the name in `field` is unknown, it names that field.
    pub fn of_name(self, field: &str) -> Self {
        match self {
            Self::NotFound { .. } | Self::NotStored { .. } => self.named(field),
            other => other,
        }
    }

    /// The same error of an upload: its field is one of the upload's `first` message, unless it is
    /// one of the `later` messages.
    pub fn of_upload(self, first: &str, later: &[&str]) -> Self {
        let (Self::Invalid { field, .. }
        | Self::NotFound { field, .. }
        | Self::NotStored { field, .. }) = &self
        else {
            return self;
        };
        let outer = field.split('.').next().unwrap_or_default();
        let has_path = field.starts_with(&format!("{first}.")) || later.contains(&outer);
        if has_path { self } else { self.within(first) }
    }

    /// The same error with its field replaced by another name.
    pub fn named(self, name: &str) -> Self {
        match self {
            Self::Invalid { problem, .. } => Self::Invalid {
                field: name.to_owned(),
                problem,
            },
            Self::NotFound {
                missing, problem, ..
            } => Self::NotFound {
                field: name.to_owned(),
                missing,
                problem,
            },
            Self::NotStored {
                missing, problem, ..
            } => Self::NotStored {
                field: name.to_owned(),
                missing,
                problem,
            },
            other => other,
        }
    }

    /// The gRPC code.
    pub fn code(&self) -> Code {
        match self {
            Self::Invalid { .. } => Code::InvalidArgument,
            Self::NotFound { .. } | Self::NotStored { .. } => Code::NotFound,
            Self::Precondition(_) | Self::Quota { .. } => Code::FailedPrecondition,
            Self::Exists { .. } => Code::AlreadyExists,
            Self::Conflict { .. } => Code::Aborted,
            Self::Transport { code, .. } => *code,
            Self::Loading => Code::Unavailable,
            Self::Full { .. } => Code::ResourceExhausted,
            Self::UnknownPath => Code::Unimplemented,
            Self::Unauthenticated { .. } => Code::Unauthenticated,
            Self::Forbidden { .. } | Self::OutOfScope { .. } => Code::PermissionDenied,
            Self::Deadline => Code::DeadlineExceeded,
            Self::Cancelled => Code::Cancelled,
            Self::Internal => Code::Internal,
        }
    }
}

impl From<Error> for tonic_types::Status {
    /// The status of one request of a batch, with the details that the request alone would get.
    fn from(error: Error) -> Self {
        let status = Status::from(error);
        // The details are those that the conversion above encodes.
        Self::decode(status.details()).unwrap_or_else(|_| Self {
            code: status.code().into(),
            message: status.message().to_owned(),
            details: Vec::new(),
        })
    }
}

impl From<Error> for Status {
    fn from(error: Error) -> Self {
        let mut details = ErrorDetails::new();
        let mut metadata = std::collections::HashMap::new();
        match &error {
            Error::Full { what } => metadata.insert("full".to_owned(), what.to_string()),
            Error::Forbidden { verb } => metadata.insert("verb".to_owned(), (*verb).to_owned()),
            _ => None,
        };
        details.set_error_info(<&str>::from(&error), DOMAIN, metadata);

        // Standard google.rpc details: a client gets the invalid field, the missing resource, or
        // the retry delay without parsing the message.
        match &error {
            Error::Invalid { field, problem } => {
                details.add_bad_request_violation(brief(field), brief(problem));
            }
            Error::NotFound {
                field,
                missing: Missing { kind, name },
                problem,
            }
            | Error::NotStored {
                field,
                missing: Missing { kind, name },
                problem,
            }
            | Error::Exists {
                field,
                there: Missing { kind, name },
                problem,
            } => {
                details.add_bad_request_violation(brief(field), brief(problem));
                details.set_resource_info(*kind, brief(name), "", brief(problem));
            }
            Error::Full { .. } => {
                details.set_retry_info(Some(std::time::Duration::from_millis(500)));
            }
            _ => {}
        }

        Self::with_error_details(error.code(), brief(&error.to_string()), details)
    }
}

/// The text as one line of at most 300 characters, plus an ellipsis if it was cut. Messages may
/// quote the request, and gRPC metadata must stay small.
pub fn brief(text: &str) -> String {
    const MOST: usize = 300;

    let mut line: String = text
        .chars()
        .take(MOST)
        .map(|c| if c.is_control() { ' ' } else { c })
        .collect();

    if text.chars().nth(MOST).is_some() {
        line.push('…');
    }

    line
}

impl From<cancel::Cancelled> for Error {
    fn from(_: cancel::Cancelled) -> Self {
        Self::Cancelled
    }
}

impl From<navigation::Error> for Error {
    fn from(error: navigation::Error) -> Self {
        use navigation::Error as E;

        // The field that the caller has to change. Errors that no change of the request can fix
        // return early.
        let field = match &error {
            E::SourceFrame(room::Error::UnknownFrame {
                frame, frame_count, ..
            }) => {
                return Self::no_frame("source.frame_id", *frame, *frame_count);
            }
            E::TargetFrame(room::Error::UnknownFrame {
                frame, frame_count, ..
            }) => {
                return Self::no_frame("motion.target_frame_id", *frame, *frame_count);
            }
            E::Cancelled(_) => return Self::Cancelled,
            // Features were checked when the store was loaded, so a mismatch here is internal.
            E::FeatureRows { .. } | E::Features(_) => return Self::Internal,
            E::SourceFrame(_) => "source.frame_id",
            E::TargetFrame(_) => "motion.target_frame_id",
            E::Adapter(problem) if lacks_method(problem) => "navigator",
            E::Adapter(problem) => return view_error(problem).within("source"),
            E::Refit(_) | E::Pairs(_) => return Self::Precondition(error.to_string()),
            E::Steps { .. } => "steps",
            E::TopK { .. } | E::FramesInAnswer { .. } => "top_k",
            E::NoTwist | E::TwistNotFinite { .. } | E::TwistBeyondPi { .. } => "motion",
            E::PoseNeeded { .. } => "source_pose",
            E::ViewNeeded => "source.latent",
            E::NoCandidates { .. } => "exclude_radius",
        };

        Self::invalid(field, error)
    }
}

/// Whether the adapter cannot do what the navigator asks for.
fn lacks_method(error: &adapter::Error) -> bool {
    use adapter::Error as E;
    matches!(
        error,
        E::NoCorrector { .. }
            | E::NoRelational
            | E::NoErrorCovariance
            | E::GatedMotion
            | E::WhitenedColumns { .. }
    )
}

/// An error for a feature or latent that does not fit the adapter. Its field is relative to the
/// view.
pub fn view_error(error: &adapter::Error) -> Error {
    use adapter::Error as E;

    let field = match error {
        E::LatentDim { .. }
        | E::LatentRange { .. }
        | E::Gate { .. }
        | E::NotFinite { what: "latent", .. } => "latent.values",
        E::FeatureSource { .. } => "feature.feature_set",
        _ => "feature.values",
    };

    Error::invalid(field, error)
}

impl From<eval::Error> for Error {
    fn from(error: eval::Error) -> Self {
        use eval::Error as E;

        // As above, with the field names of the evaluation requests.
        let field = match &error {
            E::Cancelled(_) | E::Navigation(navigation::Error::Cancelled(_)) => {
                return Self::Cancelled;
            }
            E::Navigation(navigation::Error::Adapter(problem)) | E::Adapter(problem)
                if lacks_method(problem) =>
            {
                "navigators"
            }
            E::Navigation(navigation::Error::Refit(_)) => {
                return Self::Precondition(error.to_string());
            }

            // Evaluations use the room's own frames and features, which were checked when the
            // store was loaded.
            E::Navigation(_) | E::Adapter(_) => return Self::Internal,
            E::Room(_) => "room",
            E::Pairs(
                splits::Error::ZeroStride
                | splits::Error::NoPairs { .. }
                | splits::Error::EmptyRange { .. },
            ) => "stride",
            E::Pairs(splits::Error::NoDatasetSplit) => "split",
            E::Threshold { .. } | E::ThresholdCount { .. } => "thresholds",
            E::NoCandidates { .. } => "exclude_radius",
            E::NothingToFitOn { .. } => "navigators",
            E::NoPredictions | E::MixedPredictions => "predictions",
            E::NotACandidate { .. } | E::NotATestPair { .. } | E::Excluded { .. } => "predictions",
            E::Prediction { position, problem } => {
                return Self::invalid(format!("predictions[{position}]"), problem);
            }
        };

        Self::invalid(field, error)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: UploadRoomRequest: its fields are room, frames, keypoints and end.
    #[test]
    fn the_field_of_an_upload_is_a_path() {
        let path = |field: &str| {
            let error = Error::invalid(field, "is wrong").of_upload("room", &["frames", "end"]);
            let Error::Invalid { field, .. } = error else {
                panic!("{error:?}");
            };
            field
        };
        assert_eq!(path("request_id"), "room.request_id");
        assert_eq!(path("room"), "room.room");
        assert_eq!(path("room.mode"), "room.mode");
        assert_eq!(path("frames"), "frames");
        assert_eq!(path("frames.features"), "frames.features");

        let unknown = Error::not_found("room", "a", []);
        assert!(
            unknown
                .of_upload("room", &[])
                .to_string()
                .starts_with("room.room: ")
        );
        assert_eq!(Error::Internal.of_upload("room", &[]), Error::Internal);
    }

    /// Oracle: the hand-written `docs/errors.md`, which has a row with reason and code for each
    /// error.
    #[test]
    fn every_reason_is_documented() {
        let page =
            std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/errors.md"))
                .unwrap();
        let name = || "a".to_owned();
        let errors = [
            (Error::invalid("a", "b"), "INVALID_ARGUMENT"),
            (Error::no_frame("a", FrameId(0), 1), "NOT_FOUND"),
            (
                Error::NotStored {
                    field: name(),
                    missing: Missing::of("room", "a"),
                    problem: name(),
                },
                "NOT_FOUND",
            ),
            (Error::Precondition(name()), "FAILED_PRECONDITION"),
            (Error::Loading, "UNAVAILABLE"),
            (
                Error::Full {
                    what: Full::Streams,
                },
                "RESOURCE_EXHAUSTED",
            ),
            (
                Error::Exists {
                    field: name(),
                    there: Missing::of("room", "a"),
                    problem: name(),
                },
                "ALREADY_EXISTS",
            ),
            (Error::Quota { problem: name() }, "FAILED_PRECONDITION"),
            (Error::UnknownPath, "UNIMPLEMENTED"),
            (Error::Unauthenticated { problem: "a" }, "UNAUTHENTICATED"),
            (
                Error::Conflict {
                    name: name(),
                    problem: name(),
                },
                "ABORTED",
            ),
            (Error::Forbidden { verb: "a" }, "PERMISSION_DENIED"),
            (Error::OutOfScope { what: "a" }, "PERMISSION_DENIED"),
            (Error::Deadline, "DEADLINE_EXCEEDED"),
            (Error::Cancelled, "CANCELLED"),
            (Error::Internal, "INTERNAL"),
        ];

        for (error, code) in errors {
            let row = format!("| `{}` | `{code}` |", <&str>::from(&error));
            assert!(page.contains(&row), "{row}");
        }
    }

    /// Oracle: by hand. One missing letter of seven gives a similarity of 0.86; another name shares
    /// hardly a letter.
    #[test]
    fn a_name_that_is_nearly_right_is_suggested() {
        let served = ["kitchen".to_owned(), "office".to_owned()];
        let message = |name: &str| Error::not_found("room", name, &served).to_string();

        assert_eq!(
            message("kitchn"),
            "room: 'kitchn' is not served; did you mean 'kitchen'?"
        );
        assert_eq!(message("hallway"), "room: 'hallway' is not served");
        assert_eq!(
            message("rooms/office"),
            "room: 'rooms/office' is not served; send the name alone, 'office'"
        );
    }
}
