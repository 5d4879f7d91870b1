//! Converts domain types to wire types for answers.

use nalgebra::{Matrix6, Vector3};

use super::super::snapshot::{ServedNavigator, ServedRoom};
use super::{CAMERA, world_frame};
use seese3_client::proto::v1 as pb;
use seese3_core::adapter::{Adapter, Loss, Mixing};
use seese3_core::eval::{RetrievalScores, Row};
use seese3_core::features::FeatureSource;
use seese3_core::geometry::{CameraIntrinsics, Distortion, Pose, Twist};
use seese3_core::motion_scores::MotionScores;
use seese3_core::navigation::NavigatorKind;
use seese3_core::navigation::{
    AnswerStep, Method, Mode, Query, Reading, RetrievedFrame, StepError, StepKind,
};
use seese3_core::room::Room;
use seese3_core::splits::Split;
use seese3_core::statistics::Rate;
use seese3_store::StoredAdapter;

pub fn vector_to_wire(vector: &Vector3<f64>) -> pb::Vector3 {
    pb::Vector3 {
        x: vector.x,
        y: vector.y,
        z: vector.z,
    }
}

/// The 36 numbers of the matrix in row-major order.
pub fn matrix_to_wire(matrix: &Matrix6<f64>) -> Vec<f64> {
    // nalgebra is column-major; iterating the transpose gives row-major order.
    matrix.transpose().iter().copied().collect()
}

pub fn twist_to_wire(twist: &Twist) -> pb::Twist {
    pb::Twist {
        linear: Some(vector_to_wire(&twist.linear)),
        angular: Some(vector_to_wire(&twist.angular)),
    }
}

pub fn pose_to_wire(pose: &Pose, room: &str) -> pb::Pose {
    let q = pose.rotation.quaternion();
    pb::Pose {
        parent_frame: world_frame(room),
        child_frame: CAMERA.to_owned(),
        position: Some(vector_to_wire(&pose.translation.vector)),
        orientation: Some(pb::Quaternion {
            w: q.w,
            x: q.i,
            y: q.j,
            z: q.k,
        }),
    }
}

pub fn retrieved_to_wire(retrieved: &RetrievedFrame, room: &Room) -> pb::RetrievedFrame {
    let frame = retrieved.neighbor.frame;
    pb::RetrievedFrame {
        frame_id: frame.0,
        distance: retrieved.neighbor.distance,
        pose: Some(pose_to_wire(&retrieved.pose, room.id().as_str())),
        frame_name: room
            .frame_names()
            .get(frame.row())
            .cloned()
            .unwrap_or_default(),
        timestamp_ns: room.timestamps_ns().get(frame.row()).copied(),
    }
}

pub fn step_to_wire(
    number: usize,
    step: &AnswerStep,
    room: &Room,
    adapter: &pb::Revision,
) -> pb::NavigationStep {
    pb::NavigationStep {
        step: number as u32,
        frames: step
            .frames
            .iter()
            .map(|frame| retrieved_to_wire(frame, room))
            .collect(),
        requested_pose: step
            .requested_pose
            .map(|pose| pose_to_wire(&pose, room.id().as_str())),
        error: step.error.map(|error| error_to_wire(&error)),
        latent: step.latent.as_ref().map(|latent| pb::Latent {
            values: latent.to_vec(),
            adapter: Some(adapter.clone()),
        }),
    }
}

pub fn error_to_wire(error: &StepError) -> pb::PoseError {
    pb::PoseError {
        translation_m: error.pose.translation_m,
        rotation_rad: error.pose.rotation_rad,
        twist_norm: error.twist,
    }
}

/// Names of the adapter's navigators, with the paper's metric.
pub fn navigator_names(adapter: &Adapter) -> Vec<String> {
    let has = |step: &StepKind| match step {
        StepKind::Corrector(kind) => adapter
            .correctors()
            .any(|corrector| corrector.kind() == *kind),
        StepKind::InversePoincare(_) | StepKind::Refit(_) => true,
    };
    let relational = adapter
        .relational()
        .map(|_| NavigatorKind::Relational.name());
    StepKind::all()
        .into_iter()
        .filter(has)
        .map(StepKind::name)
        .chain(relational)
        .collect()
}

/// The name of the query's navigator.
pub fn navigator_to_wire(query: &Query) -> String {
    query.method.navigator().name()
}

/// The variant of a method's inverse; unspecified for a navigator without one.
pub fn variant_to_wire(method: Method) -> pb::InverseVariant {
    let Method::Latent(step, _) = method else {
        return pb::InverseVariant::Unspecified;
    };
    match step {
        StepKind::InversePoincare(Reading::Affine) => pb::InverseVariant::Affine,
        StepKind::InversePoincare(Reading::Homogeneous) => pb::InverseVariant::Homogeneous,
        StepKind::InversePoincare(Reading::Literal) => pb::InverseVariant::Literal,
        StepKind::Corrector(_) | StepKind::Refit(_) => pb::InverseVariant::Unspecified,
    }
}

pub fn mode_to_wire(mode: Mode) -> pb::StepMode {
    match mode {
        Mode::OpenLoop => pb::StepMode::OpenLoop,
        Mode::Snap => pb::StepMode::Snap,
        Mode::ClosedLoop => pb::StepMode::ClosedLoop,
    }
}

pub fn room_revision(navigator: &ServedNavigator) -> pb::Revision {
    pb::Revision {
        name: navigator.navigator.room().id().to_string(),
        revision: navigator.room_revision,
    }
}

/// The revision of a served room.
pub fn served_revision(room: &ServedRoom) -> pb::Revision {
    pb::Revision {
        name: room.id.to_string(),
        revision: room.summary.revision,
    }
}

pub fn adapter_revision(navigator: &ServedNavigator) -> pb::Revision {
    pb::Revision {
        name: navigator.adapter.name.clone(),
        revision: navigator.adapter.revision,
    }
}

/// A manifest's RFC 3339 time as a timestamp; `None` if it cannot be parsed.
pub fn time_to_wire(stated: &str) -> Option<prost_types::Timestamp> {
    let time = chrono::DateTime::parse_from_rfc3339(stated).ok()?;
    Some(prost_types::Timestamp {
        seconds: time.timestamp(),
        nanos: i32::try_from(time.timestamp_subsec_nanos()).ok()?,
    })
}

/// A camera as a wire message, in units of the image width.
pub fn camera_to_wire(camera: &CameraIntrinsics) -> pb::CameraIntrinsics {
    let distortion = camera.distortion();
    let model = match distortion {
        Distortion::None => pb::DistortionModel::Unspecified,
        Distortion::BrownConrady(_) => pb::DistortionModel::BrownConrady,
        Distortion::KannalaBrandt(_) => pb::DistortionModel::KannalaBrandt,
    };

    pb::CameraIntrinsics {
        width: 1.0,
        height: camera.height(),
        fx: camera.focal().x,
        fy: camera.focal().y,
        cx: Some(camera.center().x),
        cy: Some(camera.center().y),
        distortion_model: model.into(),
        distortion: distortion.coefficients().to_vec(),
    }
}

/// A feature source as a wire message.
pub fn source_to_wire(source: &FeatureSource) -> pb::FeatureSource {
    let FeatureSource {
        name,
        encoder,
        layer,
        base,
        norm,
        pooling,
        preprocess,
        dim,
        parts,
    } = source.clone();

    pb::FeatureSource {
        name,
        encoder,
        layer,
        pooling,
        preprocess,
        dim: dim as u32,
        layer_index_base: base_to_wire(&base).into(),
        final_norm: norm_to_wire(&norm).into(),
        parts: parts.iter().map(source_to_wire).collect(),
    }
}

pub fn scores_to_wire(scores: &MotionScores) -> pb::MotionScores {
    // R² is NaN if the true motions do not vary; the field is then absent.
    let known = |value: f64| value.is_finite().then_some(value);
    pb::MotionScores {
        pair_count: scores.n as u32,
        overall: known(scores.overall),
        translation: known(scores.translation),
        rotation: known(scores.rotation),
        direction: known(scores.direction),
        magnitude: known(scores.magnitude),
        still_components: if scores.n == 0 {
            0
        } else {
            scores.still_components() as u32
        },
    }
}

pub fn row_to_wire(row: &Row) -> pb::NavigatorScores {
    let RetrievalScores {
        top1,
        hits,
        translation_m_median,
        rotation_rad_median,
        pose_recalls,
        ..
    } = &row.retrieval;

    let over_identity = |threshold: f64| {
        let mut differences = row.hits_over_identity.iter();
        let (_, difference) = differences.find(|(epsilon, _)| *epsilon == threshold)?;
        Some(pb::ShareDifference {
            value: difference.mean,
            low: difference.low,
            high: difference.high,
        })
    };

    pb::NavigatorScores {
        name: row.name.clone(),
        pair_count: row.n as u32,
        latent_mse: row.latent.map(|latent| latent.mse),
        latent_r2: row
            .latent
            .map(|latent| latent.r2)
            .filter(|r2| r2.is_finite()),
        top1: Some(proportion_to_wire(top1)),
        hit_rates: hits
            .iter()
            .map(|(threshold, rate)| pb::HitRate {
                threshold: *threshold,
                proportion: Some(proportion_to_wire(rate)),
                over_identity: over_identity(*threshold),
            })
            .collect(),
        leaks: row.leaks,
        translation_m_median: *translation_m_median,
        rotation_rad_median: *rotation_rad_median,
        recalls: pose_recalls
            .iter()
            .map(|recall| pb::PoseRecall {
                translation_m: recall.translation_m,
                rotation_rad: recall.rotation_deg.to_radians(),
                proportion: Some(proportion_to_wire(&recall.rate)),
            })
            .collect(),
    }
}

fn proportion_to_wire(rate: &Rate) -> pb::Proportion {
    pb::Proportion {
        value: rate.rate,
        low: rate.low,
        high: rate.high,
    }
}

/// A split as a wire value.
pub fn split_to_wire(split: Split) -> pb::Split {
    match split {
        Split::Time => pb::Split::Time,
        Split::Fold1 => pb::Split::Fold1,
        Split::Fold2 => pb::Split::Fold2,
        Split::Fold3 => pb::Split::Fold3,
        Split::Fold4 => pb::Split::Fold4,
        Split::Fold5 => pb::Split::Fold5,
        Split::Blocks => pb::Split::Blocks,
        Split::Pairs => pb::Split::Pairs,
        Split::Dataset => pb::Split::Dataset,
        Split::Whole => pb::Split::Whole,
    }
}

/// A training loss as a wire value.
pub fn loss_to_wire(loss: Loss) -> pb::TrainingLoss {
    match loss {
        Loss::MeanSquaredError => pb::TrainingLoss::Mse,
        Loss::Cosine => pb::TrainingLoss::Cosine,
        Loss::Rotation => pb::TrainingLoss::Rotation,
    }
}

/// The mixing of charts as a wire value.
pub fn mixing_to_wire(mixing: Mixing) -> pb::ChartMixing {
    match mixing {
        Mixing::Gate => pb::ChartMixing::Gate,
        Mixing::Even => pb::ChartMixing::Even,
    }
}

/// Where the numbering of layers starts; unspecified for a value that this version does not know.
fn base_to_wire(base: &str) -> pb::LayerIndexBase {
    match base {
        "0" => pb::LayerIndexBase::Zero,
        "1" => pb::LayerIndexBase::One,
        "name" => pb::LayerIndexBase::Name,
        _ => pb::LayerIndexBase::Unspecified,
    }
}

/// Whether a final normalization was applied; unspecified for a value that this version does not
/// know.
fn norm_to_wire(norm: &str) -> pb::FinalNorm {
    match norm {
        "none" => pb::FinalNorm::None,
        "final" => pb::FinalNorm::Applied,
        _ => pb::FinalNorm::Unspecified,
    }
}

/// A motion and the covariance of its twist's six numbers; `None` if the errors were not measured.
pub fn motion_to_wire(twist: &Twist, covariance: Option<&Matrix6<f64>>) -> pb::TwistWithCovariance {
    pb::TwistWithCovariance {
        twist: Some(twist_to_wire(twist)),
        covariance: covariance.map_or_else(Vec::new, matrix_to_wire),
    }
}

/// A revision of an adapter.
pub fn stored_revision(stored: &StoredAdapter) -> pb::Revision {
    pb::Revision {
        name: stored.name.clone(),
        revision: stored.revision,
    }
}
