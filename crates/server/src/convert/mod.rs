//! Conversion between wire types and domain types. Messages of a single service are converted in
//! that service's module.

mod incoming;
mod outgoing;

pub use incoming::{
    ImageCamera, adapter_of_latents, camera, check_length, exclusion, final_norm, image_camera,
    layer_index_base, mode_of, navigators, pose, prediction, query, source, split, stated_adapter,
    thresholds,
};
pub use outgoing::*;

/// Default child frame of poses; a Track stream may choose another name.
const CAMERA: &str = "camera";
/// Default name of the map frame of a Track stream.
pub const MAP: &str = "map";

/// The name of a room's world frame, the parent frame of its poses.
pub fn world_frame(room: &str) -> String {
    format!("rooms/{room}")
}

#[cfg(test)]
mod tests {
    use super::*;
    use seese3_client::proto::v1 as pb;
    use seese3_core::geometry::{CameraIntrinsics, Distortion, PixelCamera};

    fn photographs() -> pb::CameraIntrinsics {
        pb::CameraIntrinsics {
            width: 640.0,
            height: 480.0,
            fx: 525.0,
            ..pb::CameraIntrinsics::default()
        }
    }

    /// Oracle: the comments of the message, by hand.
    #[test]
    fn omitted_numbers_of_a_camera_have_their_defaults() {
        let expected = PixelCamera {
            width: 640.0,
            height: 480.0,
            focal: [525.0, 525.0].into(),
            center: Some([320.0, 240.0].into()),
            distortion: Distortion::None,
        };
        let given = camera(&photographs()).unwrap();
        assert_eq!(given, CameraIntrinsics::new(expected).unwrap());

        let given = pb::CameraIntrinsics {
            fy: 530.0,
            cx: Some(330.0),
            distortion_model: pb::DistortionModel::BrownConrady.into(),
            distortion: vec![0.1, -0.2],
            ..photographs()
        };
        let expected = PixelCamera {
            focal: [525.0, 530.0].into(),
            center: Some([330.0, 240.0].into()),
            distortion: Distortion::BrownConrady([0.1, -0.2, 0.0, 0.0, 0.0]),
            ..expected
        };
        assert_eq!(
            camera(&given).unwrap(),
            CameraIntrinsics::new(expected).unwrap()
        );
    }

    /// Oracle: the definition of an inverse.
    #[test]
    fn a_camera_survives_the_wire() {
        for distortion in [
            Distortion::None,
            Distortion::BrownConrady([0.1, -0.2, 0.001, -0.002, 0.03]),
            Distortion::KannalaBrandt([-0.03, 0.01, -0.002, 0.0005]),
        ] {
            let known = CameraIntrinsics::new(PixelCamera {
                width: 640.0,
                height: 480.0,
                focal: [525.0, 530.0].into(),
                center: Some([330.0, 250.0].into()),
                distortion,
            })
            .unwrap();
            assert_eq!(camera(&camera_to_wire(&known)).unwrap(), known);
        }
    }

    /// Oracle: the comments of the message.
    #[test]
    fn errors_of_a_distortion_name_the_field() {
        let brown_conrady = pb::DistortionModel::BrownConrady.into();
        let kannala_brandt = pb::DistortionModel::KannalaBrandt.into();
        for (model, count, field) in [
            (0, 1, "camera.distortion_model"),
            (9, 0, "camera.distortion_model"),
            (brown_conrady, 6, "camera.distortion"),
            (kannala_brandt, 3, "camera.distortion"),
            (kannala_brandt, 5, "camera.distortion"),
        ] {
            let given = pb::CameraIntrinsics {
                distortion_model: model,
                distortion: vec![0.01; count],
                ..photographs()
            };
            let error = camera(&given).unwrap_err();
            let named =
                matches!(&error, crate::Error::Invalid { field: named, .. } if named == field);
            assert!(named, "{model}, {count}: {error:?}");
        }

        let folded = pb::CameraIntrinsics {
            distortion_model: brown_conrady,
            distortion: vec![-2.0],
            ..photographs()
        };
        let error = camera(&folded).unwrap_err().to_string();
        assert!(error.contains("folds the image"), "{error}");
    }
}
