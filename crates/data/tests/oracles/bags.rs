//! Bags of ROS 2 and recordings of Foxglove, which rosbags and foxglove wrote
//! (tests/golden/datasets/make_bags.py).

use std::path::{Path, PathBuf};

use nalgebra::Matrix4;
use seese3_core::geometry::Pose;
use seese3_data::datasets::{
    Bag, DropReason, Error, Reader, Recording, Unusable, WrittenImages, read_bag,
};
use seese3_testing::json;

use crate::more_datasets::{folder, lenient};

/// Oracle: SciPy's interpolation of the poses that rosbags wrote (make_bags.py).
fn expected_of_bags(name: &str) -> Vec<Matrix4<f64>> {
    let file = json(&folder("expected_bags.json"));
    let matrix = |numbers: &serde_json::Value| {
        let numbers = numbers.as_array().unwrap().iter();
        Matrix4::from_row_iterator(numbers.map(|x| x.as_f64().unwrap()))
    };
    file[name].as_array().unwrap().iter().map(matrix).collect()
}

fn read_bag_of(
    file: &str,
    bag: Bag,
) -> (tempfile::TempDir, Result<(Recording, WrittenImages), Error>) {
    let images = tempfile::tempdir().unwrap();
    let bag = Bag {
        images: images.path().join("images"),
        ..bag
    };
    let found = lenient(|reader| read_bag(&folder(file), &bag, reader));
    (images, found)
}

#[test]
fn a_bag_of_ros_gives_the_poses_at_the_times_of_its_images() {
    let text = |text: &str| Some(text.to_owned());
    // The camera on the base, as make_bags.py has it.
    let base_from_camera = Pose::from_parts(
        nalgebra::Translation3::new(0.2, 0.0, 0.4),
        nalgebra::UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(0.5, -0.5, 0.5, -0.5)),
    );

    let cases = [
        // The odometry is that of the base; /tf_static says where the camera is on it.
        (text("/odom"), None, None, "odom_from_camera"),
        (
            text("/odom"),
            None,
            Some(base_from_camera),
            "odom_from_camera",
        ),
        (
            text("/odom"),
            None,
            Some(Pose::identity()),
            "odom_from_base",
        ),
        (None, text("map"), None, "map_from_camera"),
        (None, text("/odom"), None, "odom_from_camera"),
    ];
    for (pose_topic, world, base_from_camera, expected) in cases {
        for (file, topic) in [
            ("bag.mcap", "/camera/compressed"),
            ("bag.mcap", "/camera/raw"),
            ("bag.db3", "/camera/compressed"),
            ("bag.db3", "/camera/raw"),
        ] {
            let bag = Bag {
                image_topic: text(topic),
                pose_topic: pose_topic.clone(),
                world: world.clone(),
                base_from_camera,
                ..Bag::default()
            };
            let (_images, found) = read_bag_of(file, bag);
            let (found, written) = found.unwrap();

            // The last image lies behind the last pose.
            assert_eq!(found.dropped.len(), 1);
            assert_eq!(found.dropped[0].reason, DropReason::NoPoseWithinTolerance);
            for (pose, expected) in found.frames.poses.iter().zip(expected_of_bags(expected)) {
                let off = (pose.to_homogeneous() - expected).amax();
                assert!(off < 1e-9, "{topic}, {expected}: off by {off}");
            }
            let times = json(&folder("expected_bags.json"))["times_ns"].clone();
            assert_eq!(serde_json::json!(found.frames.timestamps_ns), times);

            // Red counts the images, 40 by 40; JPEG changes it by a few.
            let image = written.folder().join(&found.frames.images[3]);
            let pixel = image::open(image).unwrap().to_rgb8().get_pixel(4, 3).0;
            assert!(
                pixel[0].abs_diff(120) < 4 && pixel[2].abs_diff(10) < 4,
                "{topic}: {pixel:?}"
            );
        }
    }
}

/// Oracle: the same bag in one file. ROS 2 begins a new file after some time or size; its folder
/// also holds a description.
#[test]
fn a_bag_of_several_files_is_read_as_one() {
    let bag = tempfile::tempdir().unwrap();
    let whole = std::fs::read(folder("bag.db3")).unwrap();
    // Of eleven files, the first half of the messages is in file 9 and the other half in file 10.
    for (name, others) in [("bag_9.db3", "id > 15"), ("bag_10.db3", "id <= 15")] {
        let file = bag.path().join(name);
        std::fs::write(&file, &whole).unwrap();
        let database = rusqlite::Connection::open(file).unwrap();
        let sql = format!("DELETE FROM messages WHERE {others}");
        assert!(database.execute(&sql, ()).unwrap() > 0);
    }
    std::fs::write(bag.path().join("metadata.yaml"), "version: 9\n").unwrap();

    let images = tempfile::tempdir().unwrap();
    let read = |path: &Path, to: &str| {
        let bag = Bag {
            image_topic: Some("/camera/raw".to_owned()),
            world: Some("map".to_owned()),
            images: images.path().join(to),
            ..Bag::default()
        };
        lenient(|reader| read_bag(path, &bag, reader)).unwrap().0
    };
    let one = read(&folder("bag.db3"), "one");
    let split = read(bag.path(), "split");
    assert_eq!(split.frames.poses.len(), 6);
    assert_eq!(split.frames.poses, one.frames.poses);
    assert_eq!(split.frames.timestamps_ns, one.frames.timestamps_ns);
    assert_eq!(split.dropped, one.dropped);
}

#[test]
fn a_recording_of_foxglove_is_read() {
    let (_images, found) = read_bag_of("foxglove.mcap", Bag::default());
    let (found, _written) = found.unwrap();
    assert_eq!(found.frames.poses.len(), 6);
    for (pose, expected) in found
        .frames
        .poses
        .iter()
        .zip(expected_of_bags("odom_from_base"))
    {
        assert!((pose.to_homogeneous() - expected).amax() < 1e-9);
    }
}

#[test]
fn what_a_bag_lacks_is_said() {
    let refused = |file: &str, bag: Bag| read_bag_of(file, bag).1.unwrap_err().to_string();
    let named = |image: Option<&str>, pose: Option<&str>, world: Option<&str>| Bag {
        image_topic: image.map(str::to_owned),
        pose_topic: pose.map(str::to_owned),
        world: world.map(str::to_owned),
        ..Bag::default()
    };

    let problem = refused("bag.mcap", Bag::default());
    assert!(
        problem.contains("--image-topic, one of /camera/compressed, /camera/raw"),
        "{problem}"
    );
    let problem = refused("bag.mcap", named(Some("/chatter"), None, None));
    assert!(
        problem.contains("no image topic /chatter; it has /camera/compressed"),
        "{problem}"
    );
    let problem = refused("bag.mcap", named(Some("/camera/raw"), Some("/pose"), None));
    assert!(
        problem.contains("no pose topic /pose; it has /odom"),
        "{problem}"
    );
    let problem = refused("bag.mcap", named(Some("/camera/raw"), None, Some("world")));
    assert!(
        problem.contains(
            "connects 'world' and 'camera_optical'; the bag has transforms between base_link"
        ),
        "{problem}"
    );

    let whole = std::fs::read(folder("bag.mcap")).unwrap();
    let cut = tempfile::tempdir().unwrap();
    let file = cut.path().join("cut.mcap");
    for length in [0, 5, 100, whole.len() / 2] {
        std::fs::write(&file, &whole[..length]).unwrap();
        let bag = Bag {
            images: cut.path().join("images"),
            ..named(Some("/camera/raw"), None, Some("map"))
        };
        let problem = lenient(|reader| read_bag(&file, &bag, reader)).unwrap_err();
        let expected = match length {
            0 | 5 => "is neither an MCAP file nor a .db3",
            _ => "is a truncated or damaged MCAP file",
        };
        assert!(
            problem.to_string().contains(expected),
            "{length}: {problem}"
        );
    }
}

/// Bags that are no bags, and a topic that has nothing of use: each is told apart from the others.
#[test]
fn what_is_no_bag_of_ros_2_is_said() {
    let scratch = tempfile::tempdir().unwrap();
    let refused = |name: &str, pose_topic: Option<&str>| {
        let bag = Bag {
            image_topic: Some("/camera/raw".to_owned()),
            pose_topic: pose_topic.map(str::to_owned),
            images: scratch.path().join("images"),
            ..Bag::default()
        };
        let problem = lenient(|reader| read_bag(&scratch.path().join(name), &bag, reader));
        problem.unwrap_err().to_string()
    };
    let written = |name: &str, bytes: &[u8]| {
        std::fs::write(scratch.path().join(name), bytes).unwrap();
        refused(name, None)
    };
    let changed = |name: &str, sql: &str, pose_topic: Option<&str>| {
        let file = scratch.path().join(name);
        std::fs::copy(folder("bag.db3"), &file).unwrap();
        let database = rusqlite::Connection::open(file).unwrap();
        database.execute_batch(sql).unwrap();
        refused(name, pose_topic)
    };

    let whole = std::fs::read(folder("bag.db3")).unwrap();
    let cases = [
        (
            written("cut.db3", &whole[..whole.len() / 2]),
            "is a damaged .db3 bag",
        ),
        (written("one.bag", b"#ROSBAG V2.0\n"), "is a ROS 1 bag"),
        (
            written("bag.db3.zstd", b"\x28\xb5\x2f\xfd\x04\x00"),
            "is compressed as a whole",
        ),
        (
            changed("other.db3", "DROP TABLE messages", None),
            "without the table 'messages'",
        ),
        (
            changed(
                "view.db3",
                "ALTER TABLE messages RENAME TO m; CREATE VIEW messages AS SELECT * FROM m",
                None,
            ),
            "without the table 'messages'",
        ),
        (
            changed("number.db3", "UPDATE messages SET data = 3", None),
            "is a damaged .db3 bag",
        ),
        (
            changed("short.db3", "UPDATE messages SET data = x'00010000'", None),
            "the first: the message is truncated or malformed",
        ),
        (
            changed("packed.db3", "UPDATE messages SET data = x'28b52ffd'", None),
            "messages are compressed one by one",
        ),
        (
            changed(
                "poseless.db3",
                "UPDATE topics SET type = 'std_msgs/msg/String' WHERE name = '/odom'",
                None,
            ),
            "has no pose topic: supported types are ROS 2's PoseStamped",
        ),
        (
            changed(
                "silent.db3",
                "UPDATE topics SET type = 'std_msgs/msg/String' WHERE name = '/odom'",
                Some("/pose"),
            ),
            "its topics are /camera/compressed (sensor_msgs/msg/CompressedImage), ",
        ),
        (refused("nothing", None), "No such file"),
        (
            {
                std::fs::create_dir(scratch.path().join("empty")).unwrap();
                refused("empty", None)
            },
            "no .mcap and no .db3",
        ),
    ];
    for (problem, expected) in cases {
        assert!(problem.contains(expected), "{expected}: {problem}");
    }
}

/// A bag of the golden one, changed by statements of SQL, and where its images go.
struct Changed {
    folder: tempfile::TempDir,
}

impl Changed {
    fn new(sql: &str) -> Self {
        let scratch = tempfile::tempdir().unwrap();
        let file = scratch.path().join("bag.db3");
        std::fs::copy(folder("bag.db3"), &file).unwrap();
        let database = rusqlite::Connection::open(file).unwrap();
        database.execute_batch(sql).unwrap();
        Self { folder: scratch }
    }

    fn images(&self) -> PathBuf {
        self.folder.path().join("images")
    }

    fn read(&self, topic: &str, unusable: Unusable) -> Result<(Recording, WrittenImages), Error> {
        let bag = Bag {
            image_topic: Some(topic.to_owned()),
            pose_topic: Some("/odom".to_owned()),
            images: self.images(),
            ..Bag::default()
        };
        let mut reader = Reader {
            unusable,
            progress: &mut |_, _| (),
        };
        read_bag(&self.folder.path().join("bag.db3"), &bag, &mut reader)
    }
}

/// Oracle: the contract: columns and tables that compute their content are refused. Such a file of
/// a few kilobytes would be read for hours.
#[test]
fn computed_tables_are_refused() {
    let generated = "ALTER TABLE messages RENAME TO kept; CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id INTEGER, \
                     timestamp INTEGER, data BLOB GENERATED ALWAYS AS (zeroblob(900000000)) VIRTUAL); \
                     INSERT INTO messages (id, topic_id, timestamp) SELECT id, topic_id, timestamp FROM kept;";
    let view = "ALTER TABLE messages RENAME TO kept; CREATE VIEW messages AS SELECT * FROM kept;";
    let virtual_table = "DROP TABLE messages; CREATE VIRTUAL TABLE messages USING fts5(id, topic_id, timestamp, data);";
    for sql in [generated, view, virtual_table] {
        let refused = Changed::new(sql).read("/camera/raw", Unusable::Drop);
        let Err(refused) = refused else {
            panic!("{sql}");
        };
        let problem = refused.to_string();
        assert!(
            problem.contains("without the table 'messages' of plain columns"),
            "{problem}"
        );
    }
}

/// Oracle: by hand. Messages 4, 7, 11, 17, 23, 27 and 29 are the compressed images, of which the
/// last lies behind the last pose, and 1, 9, 13, 15, 19, 21 and 25 the odometry.
#[test]
fn a_bad_message_costs_its_own_frame() {
    let bad = "UPDATE messages SET data = x'00010000' WHERE id IN (11, 25)";
    let changed = Changed::new(bad);
    let (found, _written) = changed.read("/camera/compressed", Unusable::Drop).unwrap();
    let reasons: Vec<_> = found
        .dropped
        .iter()
        .map(|dropped| (dropped.name.as_str(), dropped.reason))
        .collect();
    assert_eq!(
        reasons,
        [
            ("message 7 of /odom", DropReason::MalformedMessage),
            ("000003", DropReason::MalformedMessage),
            // Without the last pose there is none behind these two images.
            ("000005", DropReason::NoPoseWithinTolerance),
            ("000006", DropReason::NoPoseWithinTolerance),
            ("000007", DropReason::NoPoseWithinTolerance),
        ]
    );
    assert_eq!(found.frames.poses.len(), 3);

    let changed = Changed::new(bad);
    let problem = changed
        .read("/camera/compressed", Unusable::Refuse)
        .unwrap_err();
    assert!(matches!(problem, Error::Strict { .. }), "{problem}");
    assert!(!changed.images().exists(), "a refused bag leaves nothing");
}

/// Images that are recorded in another order than they were taken in.
#[test]
fn frames_of_a_bag_are_in_the_order_of_their_stamps() {
    let changed = Changed::new("UPDATE messages SET id = 100 + id WHERE id = 7");
    let (found, _written) = changed.read("/camera/compressed", Unusable::Drop).unwrap();
    assert!(found.frames.timestamps_ns.is_sorted());
    assert_eq!(found.frames.poses.len(), 6);
    // Of seven images, it is the last one in the bag, and was taken second.
    assert_eq!(found.frames.images[1], "000007.jpg");
}

#[test]
fn images_of_a_bag_never_replace_a_file() {
    let changed = Changed::new("");
    let read = |topic: &str| changed.read(topic, Unusable::Drop);
    let compressed = changed.images().join("camera-compressed");

    // What is not kept leaves nothing behind, not even the folders.
    drop(read("/camera/compressed").unwrap());
    assert!(!changed.images().exists());

    // What is kept is used by the same import, and not removed with it.
    read("/camera/compressed").unwrap().1.keep();
    drop(read("/camera/compressed").unwrap());
    assert!(compressed.join("000001.jpg").is_file());

    // Another topic has its own folder.
    read("/camera/raw").unwrap().1.keep();
    assert!(changed.images().join("camera-raw/000001.png").is_file());

    // Somebody else's file stays as it is, and so does what a link leads to.
    let victim = changed.folder.path().join("victim");
    std::fs::write(&victim, "mine").unwrap();
    let image = compressed.join("000002.jpg");
    for is_link in [false, true] {
        std::fs::remove_file(&image).unwrap();
        if is_link {
            std::os::unix::fs::symlink(&victim, &image).unwrap();
        } else {
            std::fs::write(&image, "mine").unwrap();
        }
        let problem = read("/camera/compressed").unwrap_err().to_string();
        assert!(problem.contains("--images-to"), "{problem}");
        assert_eq!(std::fs::read(&image).unwrap(), b"mine");
    }
    assert!(compressed.join("000003.jpg").is_file());
}

/// The first chunk of the bag, with a size that no machine has, with another checksum, and as it
/// is.
#[test]
fn a_chunk_that_lies_is_refused() {
    let whole = std::fs::read(folder("bag.mcap")).unwrap();
    let length_at = |at: usize| u64::from_le_bytes(whole[at..at + 8].try_into().unwrap()) as usize;
    // Records are an opcode and a length; that of chunks is 6.
    let mut at = 8;
    while whole[at] != 6 {
        at += 9 + length_at(at + 1);
    }

    // After the length: the times of the first and the last message, the size and the checksum.
    let [size, checksum] = [at + 9 + 16, at + 9 + 24];
    assert!(length_at(size) < 1 << 20);
    let scratch = tempfile::tempdir().unwrap();
    for (place, bytes) in [
        (size, u64::MAX.to_le_bytes().to_vec()),
        (size, (1_u64 << 62).to_le_bytes().to_vec()),
        (at + 1, (1_u64 << 62).to_le_bytes().to_vec()),
        (checksum, vec![!whole[checksum]]),
        (checksum, vec![whole[checksum]]),
    ] {
        let mut changed = whole.clone();
        changed[place..place + bytes.len()].copy_from_slice(&bytes);
        let is_changed = changed != whole;
        let file = scratch.path().join("changed.mcap");
        std::fs::write(&file, changed).unwrap();
        let bag = Bag {
            image_topic: Some("/camera/raw".to_owned()),
            images: scratch.path().join("images"),
            ..Bag::default()
        };
        let read = lenient(|reader| read_bag(&file, &bag, reader));
        assert_eq!(read.is_err(), is_changed, "{place}");
    }
}
