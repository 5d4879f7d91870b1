//! Numbers published in the paper, printed beside ours. Encoders and rooms differ, so the numbers
//! are context, not a target.

/// R² of the alternative formulations on DINOv2-B, layer 7, three scenes, 15 seeds (Sec. A.5):
/// name, overall, translation, rotation, direction, magnitude.
pub const ALTERNATIVES: [(&str, [f64; 5]); 5] = [
    ("poincare", [0.61, 0.63, 0.59, 0.41, 0.60]),
    ("a-unanchored", [-6.82, -0.66, -12.98, -0.97, -0.99]),
    ("b-absolute", [-1.75, -0.80, -2.70, -0.98, -3.10]),
    ("c-se3-mlp", [-0.43, 0.25, -1.10, -0.05, -1.45]),
    ("d-difference-input", [0.48, 0.44, 0.53, 0.08, -0.08]),
];

/// Navigation with DINOv2, layer 7, three scenes (Sec. A.9): name, MSE, R², Top-1, Hit@0.1, 0.2,
/// 0.3, 0.5.
pub const NAVIGATION: [(&str, [f64; 7]); 6] = [
    ("identity", [0.578, -0.323, 0.0, 0.090, 0.204, 0.302, 0.523]),
    (
        "inverse-poincare-affine",
        [0.350, 0.199, 0.041, 0.252, 0.479, 0.628, 0.741],
    ),
    (
        "corrector-linear",
        [0.254, 0.414, 0.020, 0.141, 0.263, 0.342, 0.415],
    ),
    (
        "corrector-mlp-2",
        [0.280, 0.355, 0.029, 0.185, 0.342, 0.410, 0.473],
    ),
    (
        "corrector-mlp-3",
        [0.219, 0.498, 0.051, 0.261, 0.451, 0.532, 0.581],
    ),
    (
        "corrector-attention",
        [0.258, 0.407, 0.018, 0.167, 0.323, 0.383, 0.422],
    ),
];

/// Numbers of rooms, of up to 31, in which zero-shot navigation and the ridge refit beat Identity
/// at Hit@0.1 (Sec. A.10): encoder, zero-shot, refit.
pub const CROSS_ROOM: [(&str, &str, &str); 3] = [
    ("DINOv2", "19/30 (63 %)", "29/31 (94 %)"),
    ("DUSt3R", "17/29 (59 %)", "26/29 (90 %)"),
    ("V-JEPA 2.1", "19/31 (61 %)", "29/31 (94 %)"),
];

/// A collection of recordings.
#[derive(Debug, Clone, Copy)]
pub struct Recordings {
    pub name: &'static str,
    pub rooms: usize,
}

const TWELVE_SCENES: Recordings = Recordings {
    name: "12-Scenes",
    rooms: 10,
};
const SCANNET: Recordings = Recordings {
    name: "ScanNet",
    rooms: 707,
};
const ARKIT_SCENES: Recordings = Recordings {
    name: "ARKitScenes",
    rooms: 133,
};
const TUM: Recordings = Recordings {
    name: "TUM RGB-D",
    rooms: 17,
};
const SEVEN_SCENES: Recordings = Recordings {
    name: "7-Scenes",
    rooms: 46,
};

/// Success rates of adapters (Table 2): recordings, encoder, largest R², percentage of rooms above
/// 0, percentage above 0.3.
pub const SUCCESS: [(Recordings, &str, [f64; 3]); 15] = [
    (TWELVE_SCENES, "V-JEPA", [0.803, 100.0, 70.0]),
    (TWELVE_SCENES, "DUSt3R", [0.789, 90.0, 80.0]),
    (TWELVE_SCENES, "DINOv2", [0.682, 80.0, 50.0]),
    (SCANNET, "V-JEPA", [0.735, 35.0, 4.0]),
    (SCANNET, "DUSt3R", [0.711, 37.0, 6.0]),
    (SCANNET, "DINOv2", [0.673, 31.0, 3.0]),
    (ARKIT_SCENES, "V-JEPA", [0.344, 51.0, 3.0]),
    (ARKIT_SCENES, "DUSt3R", [0.412, 50.0, 4.0]),
    (ARKIT_SCENES, "DINOv2", [0.339, 47.0, 1.0]),
    (TUM, "V-JEPA", [0.337, 41.0, 12.0]),
    (TUM, "DUSt3R", [0.435, 41.0, 18.0]),
    (TUM, "DINOv2", [0.348, 35.0, 12.0]),
    (SEVEN_SCENES, "V-JEPA", [0.254, 4.0, 0.0]),
    (SEVEN_SCENES, "DUSt3R", [0.320, 7.0, 2.0]),
    (SEVEN_SCENES, "DINOv2", [0.331, 2.0, 2.0]),
];

/// Intrinsic dimension and R² of the ridge regression, at the best layer by M3 (Table 1): encoder,
/// TwoNN, MLE, M3 R².
pub const DIMENSIONS: [(&str, [f64; 3]); 4] = [
    ("DINOv2-B, layer 9", [9.15, 6.41, -0.28]),
    ("DUSt3R, layer 19", [7.16, 4.40, -0.22]),
    ("CroCo, layer 10", [7.66, 5.92, -0.42]),
    ("raw pixels", [5.01, 4.03, -5.29]),
];
