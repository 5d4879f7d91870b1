//! Frozen lists of rooms and pairs, and the scores of what others retrieve for them.
//!
//! A [`Benchmark`] names the pairs and the candidate frames of each room, and the SHA-256 of the
//! room's poses. Its own SHA-256 identifies it. A [`Submission`] has one retrieved frame per pair,
//! in the order of the benchmark. [`FeatureMetrics`] are M1 to M4 of one feature set in its rooms.

mod metrics;

pub use metrics::{Described, FeatureMetrics, MetricMeans, RoomMetrics};

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::marker::PhantomData;

use serde::de::{DeserializeOwned, Error as _, IgnoredAny, MapAccess, Visitor};
use serde::{Deserialize, Deserializer, Serialize};
use sha2::{Digest, Sha256};

use seese3_core::eval::{RetrievalScores, check_thresholds, default_thresholds};
use seese3_core::geometry::Pose;
use seese3_core::room::{FrameId, Room};
use seese3_core::splits::{Pair, Split};
use seese3_core::statistics::{RoomMean, bootstrap_mean, mean, paired_difference};

/// The format of a benchmark file.
const BENCHMARK_FORMAT: &str = "seese3 benchmark 1";
/// The format of a submission file.
const SUBMISSION_FORMAT: &str = "seese3 submission 1";

/// Largest number of characters of a name or an `about` text.
const MOST_CHARACTERS: usize = 500;

/// The name of the submission that stands still.
const IDENTITY: &str = "identity";

/// Why a benchmark or a submission is invalid. Each message names the field.
#[derive(Debug, thiserror::Error, PartialEq)]
#[error("{place}: {problem}")]
pub struct Error {
    /// The field, for example `frames.studio7-0000[3]`.
    pub place: String,
    /// What is wrong with it.
    pub problem: String,
}

impl Error {
    fn new(place: impl Into<String>, problem: impl Into<String>) -> Self {
        Self {
            place: place.into(),
            problem: problem.into(),
        }
    }
}

/// Reads a JSON file. `whole` names it in errors that are of no single field.
///
/// # Errors
/// [`Error`] names the field that is wrong.
fn from_json<T: DeserializeOwned>(bytes: &[u8], whole: &str) -> Result<T, Error> {
    let mut json = serde_json::Deserializer::from_slice(bytes);
    let parsed = serde_path_to_error::deserialize(&mut json).map_err(|error| {
        let place = error.path().to_string();
        let problem = error.into_inner();
        let text = problem.to_string();
        // The path says more than the line of a file that a program wrote, if the file is JSON at all.
        let text = match text.split_once(" at line ") {
            Some((what, _)) if problem.is_data() => what.to_owned(),
            _ => text,
        };
        let place = if place == "." {
            whole.to_owned()
        } else {
            place
        };
        Error::new(
            place,
            text.replace("expected u32", "expected a whole number from 0 on"),
        )
    })?;
    let end = json.end();
    end.map_err(|problem| Error::new(whole, problem.to_string()))?;
    Ok(parsed)
}

/// A frozen list of rooms and pairs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Benchmark {
    format: String,
    /// The name of the benchmark.
    pub name: String,
    /// The split that the pairs and the candidates are from.
    pub split: String,
    /// Frames from source to target.
    pub stride: u32,
    /// ε of Hit@ε; the first one orders the results.
    pub thresholds: Vec<f64>,
    /// The rooms.
    pub rooms: Vec<BenchmarkRoom>,
}

/// A room of a benchmark.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BenchmarkRoom {
    /// Its name.
    pub room: String,
    /// Its number of frames.
    pub frame_count: usize,
    /// SHA-256 of its poses ([`poses_sha256`]).
    pub poses_sha256: String,
    /// The sources of the pairs: ranges of rows, first and last. A target is `stride` rows later.
    pub sources: Vec<[u32; 2]>,
    /// The frames that may be retrieved: ranges of rows, first and last. The source may be
    /// retrieved.
    pub candidates: Vec<[u32; 2]>,
}

/// A benchmark with its SHA-256: the content of a benchmark file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BenchmarkFile {
    /// SHA-256 of the benchmark, as [`Benchmark::sha256`].
    sha256: String,
    benchmark: Benchmark,
    /// What made the file; not part of the benchmark.
    #[serde(default, skip_serializing)]
    made_by: IgnoredAny,
}

/// What one method retrieved for a benchmark.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Submission {
    format: String,
    /// SHA-256 of the benchmark that it answers.
    pub benchmark: String,
    /// The name of the method.
    pub name: String,
    /// One sentence: the features, what was trained on which rooms, the rule of retrieval.
    pub about: String,
    /// Where the method is described; optional.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub url: Option<String>,
    /// The retrieved frames, one per pair, by room.
    #[serde(deserialize_with = "without_duplicates")]
    pub frames: BTreeMap<String, Vec<u32>>,
    #[serde(default, skip_serializing)]
    made_by: IgnoredAny,
}

/// Reads a map, and refuses a key that occurs twice: JSON parsers keep the last one in silence.
fn without_duplicates<'de, D: Deserializer<'de>, T: Deserialize<'de>>(
    from: D,
) -> Result<BTreeMap<String, T>, D::Error> {
    struct Rooms<T>(PhantomData<T>);

    impl<'de, T: Deserialize<'de>> Visitor<'de> for Rooms<T> {
        type Value = BTreeMap<String, T>;

        fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
            f.write_str("an object with an entry for each room")
        }

        fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Self::Value, A::Error> {
            let mut rooms = BTreeMap::new();
            while let Some((room, of_room)) = map.next_entry::<String, T>()? {
                if rooms.contains_key(&room) {
                    return Err(A::Error::custom(format!("room '{room}' occurs twice")));
                }
                rooms.insert(room, of_room);
            }
            Ok(rooms)
        }
    }

    from.deserialize_map(Rooms(PhantomData))
}

/// SHA-256 of poses, as hexadecimal digits: of the 16 numbers of each `world_from_camera`, row by
/// row, in millionths, rounded half to even, as little-endian signed integers of 64 bits.
pub fn poses_sha256(poses: &[Pose]) -> String {
    let mut hash = Sha256::new();
    for pose in poses {
        let matrix = pose.to_homogeneous();
        for row in 0..4 {
            for column in 0..4 {
                let millionths = (matrix[(row, column)] * 1e6).round_ties_even();
                hash.update((millionths as i64).to_le_bytes());
            }
        }
    }
    hex::encode(hash.finalize())
}

impl Benchmark {
    /// Freezes the test pairs of a split in these rooms.
    ///
    /// # Errors
    /// [`Error`] if a room has no test pair, or the name is not valid.
    pub fn freeze<'a>(
        name: &str,
        rooms: impl IntoIterator<Item = &'a Room>,
        split: Split,
        stride: u32,
    ) -> Result<Self, Error> {
        let frozen = |room: &Room| -> Result<BenchmarkRoom, Error> {
            let pairs = split.test_pairs(room.timeline(), stride);
            let pairs = pairs.map_err(|problem| {
                Error::new(format!("room '{}'", room.id()), problem.to_string())
            })?;
            let sources: Vec<FrameId> = pairs.iter().map(|pair| pair.source).collect();
            Ok(BenchmarkRoom {
                room: room.id().to_string(),
                frame_count: room.frame_count(),
                poses_sha256: poses_sha256(room.poses()),
                sources: ranges(&sources),
                candidates: ranges(&split.candidates(room.timeline())),
            })
        };

        let benchmark = Self {
            format: BENCHMARK_FORMAT.to_owned(),
            name: name.to_owned(),
            split: split.name().to_owned(),
            stride,
            thresholds: default_thresholds(),
            rooms: rooms.into_iter().map(frozen).collect::<Result<_, _>>()?,
        };
        benchmark.check()?;
        Ok(benchmark)
    }

    /// SHA-256 of the benchmark as compact JSON, as hexadecimal digits.
    pub fn sha256(&self) -> String {
        // Text, numbers and lists always become JSON.
        let text = serde_json::to_vec(self).unwrap_or_default();
        hex::encode(Sha256::digest(text))
    }

    /// The content of its file.
    pub fn file(self) -> BenchmarkFile {
        BenchmarkFile {
            sha256: self.sha256(),
            benchmark: self,
            made_by: IgnoredAny,
        }
    }

    /// Reads the content of a file.
    ///
    /// # Errors
    /// [`Error`] if it is no benchmark, or was changed after it was frozen.
    pub fn read(bytes: &[u8]) -> Result<Self, Error> {
        let file: BenchmarkFile = from_json(bytes, "benchmark")?;
        let BenchmarkFile {
            sha256, benchmark, ..
        } = file;

        check_format(&benchmark.format, BENCHMARK_FORMAT)?;
        if sha256 != benchmark.sha256() {
            let problem = "does not match the content: the file was changed; take the original";
            return Err(Error::new("sha256", problem));
        }
        benchmark.check()?;
        Ok(benchmark)
    }

    fn check(&self) -> Result<(), Error> {
        check_text("name", &self.name)?;
        self.split()?;
        check_thresholds(&self.thresholds)
            .map_err(|problem| Error::new("thresholds", problem.to_string()))?;
        if self.stride == 0 {
            return Err(Error::new("stride", "must be at least 1"));
        }
        if self.rooms.is_empty() {
            return Err(Error::new("rooms", "must not be empty"));
        }

        let mut names = BTreeSet::new();
        for room in &self.rooms {
            room.check(self.stride)?;
            if !names.insert(&room.room) {
                return Err(Error::new(format!("room '{}'", room.room), "occurs twice"));
            }
        }
        Ok(())
    }

    /// The split of the pairs.
    ///
    /// # Errors
    /// [`Error`] if this version has no such split.
    pub fn split(&self) -> Result<Split, Error> {
        let unknown = |_| Error::new("split", format!("'{}' is not known", self.split));
        self.split.parse().map_err(unknown)
    }

    /// The submission that retrieves every source.
    pub fn standing_still(&self) -> Submission {
        let sources = |room: &BenchmarkRoom| rows(&room.sources).collect();
        let frames = self.rooms.iter().map(sources).collect();
        self.submission(IDENTITY, "Standing still: retrieves the source.", frames)
    }

    /// A submission with these retrieved frames, one list per room of the benchmark in order.
    pub fn submission(&self, name: &str, about: &str, frames: Vec<Vec<u32>>) -> Submission {
        let rooms = self.rooms.iter().map(|room| room.room.clone());
        Submission {
            format: SUBMISSION_FORMAT.to_owned(),
            benchmark: self.sha256(),
            name: name.to_owned(),
            about: about.to_owned(),
            url: None,
            frames: rooms.zip(frames).collect(),
            made_by: IgnoredAny,
        }
    }
}

impl BenchmarkRoom {
    fn check(&self, stride: u32) -> Result<(), Error> {
        let place = || format!("room '{}'", self.room);
        for ranges in [&self.sources, &self.candidates] {
            let is_ascending = ranges.iter().all(|[first, last]| first <= last)
                && ranges.windows(2).all(|pair| pair[0][1] < pair[1][0]);
            if !is_ascending {
                let problem = "has ranges that overlap or are not in ascending order";
                return Err(Error::new(place(), problem));
            }
        }
        let last = |ranges: &[[u32; 2]]| ranges.iter().flatten().copied().max();
        let (Some(source), Some(candidate)) = (last(&self.sources), last(&self.candidates)) else {
            return Err(Error::new(place(), "has no pairs or no candidates"));
        };
        if u32::try_from(self.frame_count).is_err() {
            return Err(Error::new(place(), "has too many frames"));
        }
        let last = u64::from(source) + u64::from(stride);
        if last.max(candidate.into()) >= self.frame_count as u64 {
            let problem = format!("has rows outside of its {} frames", self.frame_count);
            return Err(Error::new(place(), problem));
        }
        Ok(())
    }

    /// Refuses a room of this name with other poses.
    ///
    /// # Errors
    /// [`Error`] for other poses or another number of frames.
    pub fn check_poses(&self, poses: &[Pose]) -> Result<(), Error> {
        if poses.len() != self.frame_count || poses_sha256(poses) != self.poses_sha256 {
            let problem = "has other poses than the benchmark's; make or import the same room";
            return Err(Error::new(format!("room '{}'", self.room), problem));
        }
        Ok(())
    }

    /// The number of pairs.
    pub fn pair_count(&self) -> usize {
        rows(&self.sources).count()
    }

    /// The pairs, for the stride of the benchmark.
    pub fn pairs(&self, stride: u32) -> Vec<Pair> {
        let pair = |source| Pair {
            source: FrameId(source),
            target: FrameId(source + stride),
        };
        rows(&self.sources).map(pair).collect()
    }

    fn is_candidate(&self, row: u32) -> bool {
        let contains = |range: &[u32; 2]| (range[0]..=range[1]).contains(&row);
        self.candidates.iter().any(contains)
    }
}

impl Submission {
    /// Reads the content of a file, and checks it against the benchmark.
    ///
    /// # Errors
    /// [`Error`] names the first field that is wrong.
    pub fn read(bytes: &[u8], benchmark: &Benchmark) -> Result<Self, Error> {
        let submission: Self = from_json(bytes, "submission")?;
        submission.check(benchmark)?;
        Ok(submission)
    }

    /// Checks the submission against the benchmark.
    ///
    /// # Errors
    /// [`Error`] names the first field that is wrong.
    pub fn check(&self, benchmark: &Benchmark) -> Result<(), Error> {
        check_format(&self.format, SUBMISSION_FORMAT)?;
        check_benchmark(&self.benchmark, benchmark)?;
        check_description(&self.name, &self.about, self.url.as_deref())?;
        check_submission_text(&self.name, &self.about)?;

        let known = |name: &String| benchmark.rooms.iter().any(|room| room.room == *name);
        if let Some(other) = self.frames.keys().find(|name| !known(name)) {
            return Err(Error::new(
                format!("frames.{other}"),
                "is no room of the benchmark",
            ));
        }
        for room in &benchmark.rooms {
            let place = format!("frames.{}", room.room);
            let Some(frames) = self.frames.get(&room.room) else {
                return Err(Error::new(place, "is missing"));
            };
            if frames.len() != room.pair_count() {
                let problem = format!(
                    "has {} frames, not {}: one per pair",
                    frames.len(),
                    room.pair_count()
                );
                return Err(Error::new(place, problem));
            }
            if let Some(position) = frames.iter().position(|&row| !room.is_candidate(row)) {
                let problem = format!(
                    "is {}, which is no candidate; the candidates are the rows {:?}",
                    frames[position], room.candidates
                );
                return Err(Error::new(format!("{place}[{position}]"), problem));
            }
        }
        Ok(())
    }
}

/// The scores of a submission.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct BenchmarkScores {
    /// The name of the method.
    pub name: String,
    /// The `about` text of its file.
    pub about: String,
    /// Where it is described.
    pub url: Option<String>,
    /// Hit@ε over rooms, by ε in the order of the benchmark.
    pub hits: Vec<HitScores>,
    /// Mean over rooms of the median distance to the target, meters.
    pub median_m: f64,
    /// Mean over rooms of the median angle to the target, degrees.
    pub median_deg: f64,
}

/// Hit@ε of a submission: means over rooms, with intervals of resampled rooms.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct HitScores {
    /// ε, meters and radians mixed.
    pub threshold: f64,
    /// Hit@ε.
    pub hit: RoomMean,
    /// The difference to standing still, paired by room.
    pub over_identity: RoomMean,
    /// Hit@ε of each room.
    pub by_room: Vec<f64>,
}

/// Scores a checked submission; `rooms` has the poses of the benchmark's rooms in order,
/// `world_from_camera`.
pub fn score(benchmark: &Benchmark, submission: &Submission, rooms: &[&[Pose]]) -> BenchmarkScores {
    let thresholds = &benchmark.thresholds;
    let mut ours = Vec::with_capacity(rooms.len());
    let mut still = Vec::with_capacity(rooms.len());
    for (room, poses) in benchmark.rooms.iter().zip(rooms) {
        let pairs = room.pairs(benchmark.stride);
        let frames = submission.frames.get(&room.room).into_iter().flatten();
        let retrieved: Vec<FrameId> = frames.map(|&row| FrameId(row)).collect();
        let sources: Vec<FrameId> = pairs.iter().map(|pair| pair.source).collect();
        ours.push(RetrievalScores::of(&pairs, &retrieved, poses, thresholds));
        still.push(RetrievalScores::of(&pairs, &sources, poses, thresholds));
    }

    let rates = |scores: &[RetrievalScores], place: usize| -> Vec<f64> {
        scores.iter().map(|room| room.hits[place].1.rate).collect()
    };
    let over_rooms =
        |of: fn(&RetrievalScores) -> f64| mean(&ours.iter().map(of).collect::<Vec<_>>());
    let hits = thresholds.iter().enumerate().map(|(place, &threshold)| {
        let by_room = rates(&ours, place);
        HitScores {
            threshold,
            hit: bootstrap_mean(&by_room, 0),
            over_identity: paired_difference(&by_room, &rates(&still, place), 0),
            by_room,
        }
    });

    BenchmarkScores {
        name: submission.name.clone(),
        about: submission.about.clone(),
        url: submission.url.clone(),
        hits: hits.collect(),
        median_m: over_rooms(|scores| scores.translation_m_median),
        median_deg: over_rooms(|scores| scores.rotation_rad_median.to_degrees()),
    }
}

fn check_format(format: &str, expected: &str) -> Result<(), Error> {
    if format != expected {
        let problem = format!("is '{format}', not '{expected}'");
        return Err(Error::new("format", problem));
    }
    Ok(())
}

/// Refuses a file that was made for another benchmark.
fn check_benchmark(sha256: &str, benchmark: &Benchmark) -> Result<(), Error> {
    let expected = benchmark.sha256();
    if sha256 != expected {
        let problem = format!("is not the benchmark '{}' ({expected})", benchmark.name);
        return Err(Error::new("benchmark", problem));
    }
    Ok(())
}

/// Checks the name and the `about` text of a submission.
///
/// # Errors
/// [`Error`] names the field.
pub fn check_submission_text(name: &str, about: &str) -> Result<(), Error> {
    check_description(name, about, None)?;
    if name.to_lowercase() == IDENTITY {
        let problem = format!("'{IDENTITY}' is reserved for the baseline; choose another");
        return Err(Error::new("name", problem));
    }
    Ok(())
}

/// Checks the name, the `about` text and the address of a file.
///
/// # Errors
/// [`Error`] names the field.
pub fn check_description(name: &str, about: &str, url: Option<&str>) -> Result<(), Error> {
    check_text("name", name)?;
    check_text("about", about)?;

    if let Some(url) = url {
        let is_address = url.starts_with("https://") || url.starts_with("http://");
        let is_plain = |c: char| c.is_ascii_graphic() && !"<>()[]\"`".contains(c);
        if !is_address || !url.chars().all(is_plain) {
            let problem =
                "must be an address http://… or https://… without spaces, quotes or brackets";
            return Err(Error::new("url", problem));
        }
    }
    Ok(())
}

/// Refuses an empty text, and characters that would break the line of a table or a page.
fn check_text(place: &str, text: &str) -> Result<(), Error> {
    if text.trim().is_empty() {
        return Err(Error::new(place, "must not be empty"));
    }
    if text.trim() != text {
        return Err(Error::new(place, "must not begin or end with a blank"));
    }
    // Invisible characters, and characters that mean something in Markdown and LaTeX.
    let is_hidden = |c: char| {
        matches!(c, '\u{ad}' | '\u{200b}'..='\u{200f}' | '\u{2028}'..='\u{202e}')
            || matches!(c, '\u{2060}'..='\u{206f}' | '\u{feff}')
    };
    let is_markup = |c: char| "|<>`[]*\\^~&".contains(c);
    if text
        .chars()
        .any(|c| c.is_control() || is_hidden(c) || is_markup(c))
    {
        let problem =
            "must be one line without invisible characters and without | < > ` [ ] * \\ ^ ~ and &";
        return Err(Error::new(place, problem));
    }
    if text.chars().count() > MOST_CHARACTERS {
        return Err(Error::new(
            place,
            format!("must have at most {MOST_CHARACTERS} characters"),
        ));
    }
    Ok(())
}

/// The rows of ranges.
fn rows(ranges: &[[u32; 2]]) -> impl Iterator<Item = u32> + '_ {
    ranges.iter().flat_map(|[first, last]| *first..=*last)
}

/// Ascending rows as ranges, first and last.
fn ranges(frames: &[FrameId]) -> Vec<[u32; 2]> {
    let mut ranges: Vec<[u32; 2]> = Vec::new();
    for frame in frames {
        match ranges.last_mut() {
            Some([_, last]) if *last + 1 == frame.0 => *last = frame.0,
            _ => ranges.push([frame.0; 2]),
        }
    }
    ranges
}

#[cfg(test)]
mod tests {
    use super::*;
    use seese3_testing::world::place;

    fn benchmark() -> (Benchmark, Room) {
        let (room, _) = place("hall", 1);
        let frozen = Benchmark::freeze("test", [&room], Split::Whole, 10).unwrap();
        (frozen, room)
    }

    fn read(submission: &Submission, benchmark: &Benchmark) -> Result<Submission, Error> {
        Submission::read(&serde_json::to_vec(submission).unwrap(), benchmark)
    }

    /// Oracle: the definition of Hit@ε. Who retrieves the targets hits always; who stands still is
    /// no better than Identity.
    #[test]
    fn targets_hit_and_sources_are_identity() {
        let (benchmark, room) = benchmark();
        let answered = |end: usize| {
            let pairs = benchmark.rooms[0].pairs(10);
            let ends = |pair: &Pair| [pair.source.0, pair.target.0][end];
            let frames = pairs.iter().map(ends).collect();
            let submission = benchmark.submission("mine", "a test", vec![frames]);
            let submission = read(&submission, &benchmark).unwrap();
            score(&benchmark, &submission, &[room.poses()])
        };

        let [still, right] = [0, 1].map(answered);
        assert_eq!(right.hits[0].hit.mean, 1.0);
        assert_eq!(right.median_m, 0.0);
        assert_eq!(still.hits[0].over_identity.mean, 0.0);
        assert!(still.median_m > 0.0);
    }

    /// Oracle: by hand: each changed field is refused by name.
    #[test]
    fn wrong_files_are_refused_by_field() {
        let (benchmark, room) = benchmark();
        let pairs = benchmark.rooms[0].pairs(10);
        let frames = pairs.iter().map(|pair| pair.target.0).collect();
        let right = benchmark.submission("mine", "a test", vec![frames]);
        let name = benchmark.rooms[0].room.clone();
        let refused = |change: &dyn Fn(&mut Submission)| {
            let mut changed = right.clone();
            change(&mut changed);
            read(&changed, &benchmark).unwrap_err().to_string()
        };

        assert!(refused(&|it| it.benchmark = "0".to_owned()).starts_with("benchmark: "));
        assert!(refused(&|it| it.about = " ".to_owned()).starts_with("about: "));
        assert!(refused(&|it| it.about = "a\n# b".to_owned()).starts_with("about: "));
        for name in ["identity", "Identity", " mine", "a\u{200b}", "![x](y)"] {
            let refused = refused(&|it| it.name = name.to_owned());
            assert!(refused.starts_with("name: "), "{refused}");
        }
        assert!(refused(&|it| it.name = "a".repeat(501)).starts_with("name: "));
        assert!(refused(&|it| it.url = Some("javascript:x".to_owned())).starts_with("url: "));
        assert!(refused(&|it| it.frames.clear()).contains("is missing"));
        let other = refused(&|it| {
            it.frames.insert("other".to_owned(), Vec::new());
        });
        assert!(other.contains("frames.other: is no room"), "{other}");
        let short = refused(&|it| {
            it.frames.get_mut(&name).unwrap().pop();
        });
        assert!(short.contains("one per pair"), "{short}");
        let wrong = refused(&|it| it.frames.get_mut(&name).unwrap()[3] = 1_000_000);
        assert!(
            wrong.contains(&format!("frames.{name}[3]: is 1000000")),
            "{wrong}"
        );

        let twice = serde_json::to_string(&right).unwrap();
        let twice = twice.replacen("\"frames\":{", &format!("\"frames\":{{\"{name}\":[],"), 1);
        let twice = Submission::read(twice.as_bytes(), &benchmark).unwrap_err();
        assert!(twice.to_string().contains("occurs twice"), "{twice}");

        let file = serde_json::to_string(&benchmark.clone().file()).unwrap();
        assert_eq!(Benchmark::read(file.as_bytes()).unwrap(), benchmark);
        let changed = file.replacen("\"stride\":10", "\"stride\":11", 1);
        let error = Benchmark::read(changed.as_bytes()).unwrap_err().to_string();
        assert!(error.starts_with("sha256: "), "{error}");

        let wrong = |change: &dyn Fn(&mut Benchmark)| {
            let mut changed = benchmark.clone();
            change(&mut changed);
            let file = serde_json::to_vec(&changed.file()).unwrap();
            Benchmark::read(&file).unwrap_err().to_string()
        };
        assert!(wrong(&|it| it.rooms.clear()).starts_with("rooms: "));
        assert!(wrong(&|it| it.stride = 0).starts_with("stride: "));
        assert!(wrong(&|it| it.split = "other".to_owned()).starts_with("split: "));
        assert!(wrong(&|it| it.rooms.push(it.rooms[0].clone())).contains("occurs twice"));
        let overlap = wrong(&|it| it.rooms[0].sources = vec![[0, 9], [5, 12]]);
        assert!(overlap.contains("overlap"), "{overlap}");
        let inverted = wrong(&|it| it.rooms[0].candidates = vec![[9, 0]]);
        assert!(inverted.contains("ascending"), "{inverted}");

        let moved: Vec<Pose> = room.poses().iter().rev().copied().collect();
        assert!(benchmark.rooms[0].check_poses(room.poses()).is_ok());
        assert!(benchmark.rooms[0].check_poses(&moved).is_err());
    }

    /// Oracle: Python's `hashlib.sha256` of `struct.pack("<16q", …)` of the identity in millionths.
    #[test]
    fn poses_have_the_hash_of_other_programs() {
        let expected = "0ecc494ebb3a372a62661aeefc249f29b975582b8ba893437a0bbc6ee24c6324";
        assert_eq!(poses_sha256(&[Pose::identity()]), expected);
    }

    /// Oracle: by hand.
    #[test]
    fn rows_become_ranges() {
        let rows = [0, 1, 2, 5, 7, 8].map(FrameId);
        assert_eq!(ranges(&rows), [[0, 2], [5, 5], [7, 8]]);
        assert!(ranges(&[]).is_empty());
    }
}
