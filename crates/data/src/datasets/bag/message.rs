//! Messages of a bag and their topics.

/// A supported message type.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// sensor_msgs/msg/CompressedImage.
    RosCompressedImage,
    /// sensor_msgs/msg/Image.
    RosImage,
    /// geometry_msgs/msg/PoseStamped.
    RosPose,
    /// geometry_msgs/msg/PoseWithCovarianceStamped.
    RosPoseWithCovariance,
    /// nav_msgs/msg/Odometry.
    RosOdometry,
    /// tf2_msgs/msg/TFMessage.
    RosTransforms,
    /// foxglove.CompressedImage.
    FoxgloveCompressedImage,
    /// foxglove.PoseInFrame.
    FoxglovePose,
    /// foxglove.Odometry.
    FoxgloveOdometry,
    /// foxglove.FrameTransform.
    FoxgloveTransform,
    /// foxglove.FrameTransforms.
    FoxgloveTransforms,
}

impl Kind {
    /// The kind of a schema and encoding, or `None` if it is not supported.
    pub fn of(schema: &str, encoding: &str) -> Option<Self> {
        match (schema, encoding) {
            ("sensor_msgs/msg/CompressedImage", "cdr") => Some(Self::RosCompressedImage),
            ("sensor_msgs/msg/Image", "cdr") => Some(Self::RosImage),
            ("geometry_msgs/msg/PoseStamped", "cdr") => Some(Self::RosPose),
            ("geometry_msgs/msg/PoseWithCovarianceStamped", "cdr") => {
                Some(Self::RosPoseWithCovariance)
            }
            ("nav_msgs/msg/Odometry", "cdr") => Some(Self::RosOdometry),
            ("tf2_msgs/msg/TFMessage", "cdr") => Some(Self::RosTransforms),
            ("foxglove.CompressedImage", "protobuf") => Some(Self::FoxgloveCompressedImage),
            ("foxglove.PoseInFrame", "protobuf") => Some(Self::FoxglovePose),
            ("foxglove.Odometry", "protobuf") => Some(Self::FoxgloveOdometry),
            ("foxglove.FrameTransform", "protobuf") => Some(Self::FoxgloveTransform),
            ("foxglove.FrameTransforms", "protobuf") => Some(Self::FoxgloveTransforms),
            _ => None,
        }
    }

    /// Whether its messages are images.
    pub fn is_image(&self) -> bool {
        matches!(
            self,
            Self::RosCompressedImage | Self::RosImage | Self::FoxgloveCompressedImage
        )
    }

    /// Whether its messages are transforms between two named frames.
    pub fn is_transforms(&self) -> bool {
        matches!(
            self,
            Self::RosTransforms | Self::FoxgloveTransform | Self::FoxgloveTransforms
        )
    }

    /// Whether each of its messages is one pose.
    pub fn is_pose(&self) -> bool {
        matches!(
            self,
            Self::RosPose
                | Self::RosPoseWithCovariance
                | Self::RosOdometry
                | Self::FoxglovePose
                | Self::FoxgloveOdometry
        )
    }
}

/// The first bytes of zstd-compressed data.
pub const ZSTD: &[u8] = b"\x28\xb5\x2f\xfd";

/// A topic of a bag.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Topic {
    pub name: String,
    /// The name of its message type, such as sensor_msgs/msg/Image.
    pub schema: String,
    /// The kind of its messages, or `None` if it is not supported.
    pub kind: Option<Kind>,
}

/// A message of a supported kind.
pub struct Message<'a> {
    pub topic: &'a str,
    pub kind: Kind,
    /// The time of recording, nanoseconds.
    pub log_time_ns: i64,
    pub data: &'a [u8],
}
