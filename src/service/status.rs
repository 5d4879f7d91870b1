//! Errors as gRPC statuses. This is the only place where status codes are chosen.

use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt};

use seese3_core::{adapter, cancel, eval, navigation, room, splits};

/// The domain of this service's error reasons.
const DOMAIN: &str = "seese3.v1";

/// Why a request is refused or fails.
#[derive(Debug, thiserror::Error, PartialEq)]
#[allow(missing_docs, reason = "each variant's message says what it is")]
pub enum Error {
    #[error("{field}: {problem}")]
    Invalid { field: String, problem: String },
    #[error("{field}: '{name}' is not served")]
    NotFound { field: String, name: String },
    #[error("{0}")]
    Precondition(String),
    #[error("the server is not ready: it is loading its store or stopping; try again")]
    Loading,
    #[error("the server is busy: as many {what} as it takes are waiting or open; try again later")]
    Full { what: &'static str },
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

    /// The same error with its field prefixed by the field that contains it.
    pub fn within(self, parent: &str) -> Self {
        match self {
            Self::Invalid { field, problem } => Self::Invalid {
                field: format!("{parent}.{field}"),
                problem,
            },
            Self::NotFound { field, name } => Self::NotFound {
                field: format!("{parent}.{field}"),
                name,
            },
            other => other,
        }
    }

    /// The same error with its field replaced by another name.
    pub fn named(self, name: &str) -> Self {
        match self {
            Self::Invalid { problem, .. } => Self::Invalid {
                field: name.to_owned(),
                problem,
            },
            Self::NotFound { name: missing, .. } => Self::NotFound {
                field: name.to_owned(),
                name: missing,
            },
            other => other,
        }
    }

    /// The gRPC code.
    pub fn code(&self) -> Code {
        match self {
            Self::Invalid { .. } => Code::InvalidArgument,
            Self::NotFound { .. } => Code::NotFound,
            Self::Precondition(_) => Code::FailedPrecondition,
            Self::Loading => Code::Unavailable,
            Self::Full { .. } => Code::ResourceExhausted,
            Self::Deadline => Code::DeadlineExceeded,
            Self::Cancelled => Code::Cancelled,
            Self::Internal => Code::Internal,
        }
    }

    fn reason(&self) -> &'static str {
        match self {
            Self::Invalid { .. } => "INVALID_FIELD",
            Self::NotFound { .. } => "NOT_SERVED",
            Self::Precondition(_) => "PRECONDITION",
            Self::Loading => "NOT_READY",
            Self::Full { .. } => "BUSY",
            Self::Deadline => "DEADLINE",
            Self::Cancelled => "CANCELLED",
            Self::Internal => "INTERNAL",
        }
    }
}

impl From<Error> for Status {
    fn from(error: Error) -> Self {
        let mut details = ErrorDetails::new();
        let mut metadata = std::collections::HashMap::new();
        if let Error::Full { what } = &error {
            metadata.insert("full".to_owned(), (*what).to_owned());
        }
        details.set_error_info(error.reason(), DOMAIN, metadata);

        // Details in the standard types of google.rpc, so that a client learns the field to
        // change, the missing resource, or when to retry, without reading the message.
        match &error {
            Error::Invalid { field, problem } => {
                details.add_bad_request_violation(brief(field), brief(problem));
            }
            Error::NotFound { field, name } => {
                details.set_resource_info(brief(field), brief(name), "", "is not served");
            }
            Error::Full { .. } => {
                details.set_retry_info(Some(std::time::Duration::from_millis(500)));
            }
            _ => {}
        }

        Self::with_error_details(error.code(), brief(&error.to_string()), details)
    }
}

/// The text as one line of at most 300 characters and an ellipsis: it may quote what a caller sent,
/// and gRPC metadata must stay small.
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

        // The field that the caller has to change. Errors that no change of the request can cure
        // return early.
        let field = match &error {
            E::SourceFrame(room::Error::UnknownFrame { frame, .. }) => {
                return Self::NotFound {
                    field: "source.frame_id".to_owned(),
                    name: frame.to_string(),
                };
            }
            E::TargetFrame(room::Error::UnknownFrame { frame, .. }) => {
                let field = "displacement.target_frame_id".to_owned();
                return Self::NotFound {
                    field,
                    name: frame.to_string(),
                };
            }
            E::Cancelled(_) => return Self::Cancelled,
            // Features were checked when the store was loaded, so a misfit now is the server's
            // own fault.
            E::FeatureRows { .. } | E::Features(_) => return Self::Internal,
            E::SourceFrame(_) => "source.frame_id",
            E::TargetFrame(_) => "displacement.target_frame_id",
            E::Adapter(
                adapter::Error::NoCorrector { .. }
                | adapter::Error::NoErrorCovariance
                | adapter::Error::GatedMotion
                | adapter::Error::WhitenedColumns { .. },
            ) => "navigator",
            E::Adapter(problem) => return view_error(problem).within("source"),
            E::Refit(_) | E::Pairs(_) => return Self::Precondition(error.to_string()),
            E::Steps { .. } => "steps",
            E::HitCount { .. } | E::HitsInAll { .. } => "hit_count",
            E::NoTwist | E::TwistNotFinite { .. } | E::TwistBeyondPi { .. } => "displacement",
            E::PoseNeeded { .. } => "source_pose",
            E::NoCandidates { .. } => "exclude_radius",
        };

        Self::invalid(field, error)
    }
}

/// A feature or a latent that does not fit the adapter. The field is relative to the view that
/// contains it.
pub fn view_error(error: &adapter::Error) -> Error {
    use adapter::Error as E;

    let field = match error {
        E::LatentDim { .. }
        | E::LatentRange { .. }
        | E::Gate { .. }
        | E::NotFinite { what: "latent", .. } => "latent.values",
        E::FeatureSource { .. } => "feature.source_name",
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
            E::Navigation(navigation::Error::Adapter(
                adapter::Error::NoCorrector { .. }
                | adapter::Error::NoErrorCovariance
                | adapter::Error::GatedMotion
                | adapter::Error::WhitenedColumns { .. },
            ))
            | E::Adapter(
                adapter::Error::NoErrorCovariance
                | adapter::Error::GatedMotion
                | adapter::Error::WhitenedColumns { .. },
            ) => "navigators",
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
