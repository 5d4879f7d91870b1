//! A stream's state as bytes, number by number to the bit.

use nalgebra::{Matrix6, Quaternion, Translation3, UnitQuaternion};
use prost::Message;

use super::super::Error;
use crate::geometry::Pose;
use crate::odometry::{Belief, Candidate, Chain, Keyframe, Last, State};

/// What a token holds: what the stream was configured with, what it was answered from, and its
/// state.
#[derive(Clone, PartialEq, Message)]
pub struct Sealed {
    /// The configuration as it was sent.
    #[prost(message, optional, tag = "1")]
    pub config: Option<crate::proto::v1::TrackConfig>,
    /// Name and revision of the adapter and of every room, hashed: what the answers depend on.
    #[prost(bytes = "vec", tag = "2")]
    pub served: Vec<u8>,
    #[prost(message, optional, tag = "3")]
    pub state: Option<SealedState>,
}

#[derive(Clone, PartialEq, Message)]
pub struct SealedState {
    #[prost(uint64, optional, tag = "1")]
    room: Option<u64>,
    #[prost(message, optional, tag = "2")]
    last: Option<SealedLast>,
    #[prost(message, optional, tag = "3")]
    keyframe: Option<SealedKeyframe>,
    #[prost(double, repeated, tag = "4")]
    initial: Vec<f64>,
    /// One behind the other.
    #[prost(double, repeated, tag = "5")]
    recent: Vec<f64>,
    #[prost(uint32, tag = "6")]
    recent_count: u32,
    /// Fresh, held, held and confirmed, lost.
    #[prost(uint32, tag = "7")]
    chain: u32,
    #[prost(int32, tag = "8")]
    chain_count: i32,
    #[prost(message, optional, tag = "9")]
    candidate: Option<SealedCandidate>,
    #[prost(uint32, tag = "10")]
    unseen: u32,
    #[prost(uint32, tag = "11")]
    unlooked: u32,
}

#[derive(Clone, PartialEq, Message)]
struct SealedLast {
    #[prost(int64, tag = "1")]
    time_ns: i64,
    #[prost(uint64, tag = "2")]
    sequence: u64,
    #[prost(double, repeated, tag = "3")]
    odom: Vec<f64>,
    #[prost(double, repeated, tag = "4")]
    latent: Vec<f64>,
}

#[derive(Clone, PartialEq, Message)]
struct SealedKeyframe {
    #[prost(uint64, tag = "1")]
    sequence: u64,
    #[prost(double, repeated, tag = "2")]
    latent: Vec<f64>,
    #[prost(double, repeated, tag = "3")]
    odom: Vec<f64>,
    #[prost(double, repeated, tag = "4")]
    place: Vec<f64>,
    #[prost(double, repeated, tag = "5")]
    told: Vec<f64>,
}

#[derive(Clone, PartialEq, Message)]
struct SealedCandidate {
    #[prost(uint64, tag = "1")]
    room: u64,
    #[prost(double, repeated, tag = "2")]
    place: Vec<f64>,
    #[prost(uint32, tag = "3")]
    agreed: u32,
    #[prost(uint64, tag = "4")]
    sequence: u64,
    #[prost(double, repeated, tag = "5")]
    latent: Vec<f64>,
}

impl SealedLast {
    fn opened(self) -> Result<Last, Error> {
        let Self {
            time_ns,
            sequence,
            odom,
            latent,
        } = self;

        Ok(Last {
            time_ns,
            sequence,
            latent,
            odom: required(&odom)?,
        })
    }
}

impl SealedKeyframe {
    fn opened(self) -> Result<Keyframe, Error> {
        let Self {
            sequence,
            latent,
            odom,
            place,
            told,
        } = self;

        let place = belief_of_numbers(&place)?;
        let told = belief_of_numbers(&told)?;

        Ok(Keyframe {
            sequence,
            latent,
            odom: required(&odom)?,
            place,
            told,
        })
    }
}

impl SealedCandidate {
    fn opened(self) -> Result<Candidate, Error> {
        let Self {
            room,
            place,
            agreed,
            sequence,
            latent,
        } = self;

        Ok(Candidate {
            room: index(room)?,
            sequence,
            latent,
            place: required(&place)?,
            agreed,
        })
    }
}

fn index(room: u64) -> Result<usize, Error> {
    usize::try_from(room).map_err(|_| Error::Internal)
}

/// Translation, quaternion (x, y, z, w), and the upper half of the covariance.
fn belief_to_numbers(belief: &Belief) -> Vec<f64> {
    let t = belief.pose.translation.vector;
    let q = belief.pose.rotation.coords;
    let upper = (0..6).flat_map(|row| (row..6).map(move |column| (row, column)));

    [t.x, t.y, t.z, q.x, q.y, q.z, q.w]
        .into_iter()
        .chain(upper.map(|at| belief.covariance[at]))
        .collect()
}

/// None of no numbers.
fn belief_of_numbers(numbers: &[f64]) -> Result<Option<Belief>, Error> {
    if numbers.is_empty() {
        return Ok(None);
    }

    let &[x, y, z, i, j, k, w, ref upper @ ..] = numbers else {
        return Err(Error::Internal);
    };
    if upper.len() != 21 {
        return Err(Error::Internal);
    }

    // As it was, not normalised again: that could change the last bit.
    let rotation = UnitQuaternion::new_unchecked(Quaternion::new(w, i, j, k));
    let mut covariance = Matrix6::zeros();
    let places = (0..6).flat_map(|row| (row..6).map(move |column| (row, column)));
    for ((row, column), value) in places.zip(upper) {
        covariance[(row, column)] = *value;
        covariance[(column, row)] = *value;
    }

    Ok(Some(Belief {
        pose: Pose::from_parts(Translation3::new(x, y, z), rotation),
        covariance,
    }))
}

fn required(numbers: &[f64]) -> Result<Belief, Error> {
    belief_of_numbers(numbers)?.ok_or(Error::Internal)
}

impl From<&State> for SealedState {
    fn from(state: &State) -> Self {
        // Destructured with no `..`, so that a new field breaks the build here.
        let State {
            room,
            last,
            keyframe,
            initial,
            recent,
            chain,
            candidate,
            unseen,
            unlooked,
        } = state;

        let numbers =
            |belief: &Option<Belief>| belief.as_ref().map_or_else(Vec::new, belief_to_numbers);

        let (chain, chain_count) = match *chain {
            Chain::Fresh => (0, 0),
            Chain::Held { count, confirmed } => (1 + u32::from(confirmed), count),
            Chain::Lost { count } => (3, i32::try_from(count).unwrap_or(i32::MAX)),
        };

        Self {
            room: room.map(|room| room as u64),
            last: last.as_ref().map(
                |Last {
                     time_ns,
                     sequence,
                     latent,
                     odom,
                 }| SealedLast {
                    time_ns: *time_ns,
                    sequence: *sequence,
                    odom: belief_to_numbers(odom),
                    latent: latent.clone(),
                },
            ),
            keyframe: keyframe.as_ref().map(
                |Keyframe {
                     sequence,
                     latent,
                     odom,
                     place,
                     told,
                 }| SealedKeyframe {
                    sequence: *sequence,
                    latent: latent.clone(),
                    odom: belief_to_numbers(odom),
                    place: numbers(place),
                    told: numbers(told),
                },
            ),
            initial: numbers(initial),
            recent: recent.iter().flatten().copied().collect(),
            recent_count: recent.len() as u32,
            chain,
            chain_count,
            candidate: candidate.as_ref().map(
                |Candidate {
                     room,
                     sequence,
                     latent,
                     place,
                     agreed,
                 }| SealedCandidate {
                    room: *room as u64,
                    place: belief_to_numbers(place),
                    agreed: *agreed,
                    sequence: *sequence,
                    latent: latent.clone(),
                },
            ),
            unseen: *unseen,
            unlooked: *unlooked,
        }
    }
}

impl SealedState {
    /// The state.
    ///
    /// # Errors
    /// [`Error::Internal`] when a number is missing: no token that was sealed lacks one.
    pub fn state(self) -> Result<State, Error> {
        let Self {
            room,
            last,
            keyframe,
            initial,
            recent,
            recent_count,
            chain,
            chain_count,
            candidate,
            unseen,
            unlooked,
        } = self;

        let chain = match chain {
            0 => Chain::Fresh,
            1 | 2 => Chain::Held {
                count: chain_count,
                confirmed: chain == 2,
            },
            _ => Chain::Lost {
                count: chain_count.unsigned_abs(),
            },
        };

        let width = recent.len().checked_div(recent_count as usize).unwrap_or(0);
        let last = last.map(SealedLast::opened).transpose()?;
        let keyframe = keyframe.map(SealedKeyframe::opened).transpose()?;
        let candidate = candidate.map(SealedCandidate::opened).transpose()?;

        Ok(State {
            room: room.map(index).transpose()?,
            last,
            keyframe,
            initial: belief_of_numbers(&initial)?,
            recent: recent.chunks(width.max(1)).map(<[f64]>::to_vec).collect(),
            chain,
            candidate,
            unseen,
            unlooked,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: the promise: what was sealed comes back, to the bit.
    #[test]
    fn a_state_comes_back_to_the_bit() {
        let odd = Pose::new(
            nalgebra::Vector3::new(0.1, -2.3, 1e-17),
            nalgebra::Vector3::new(0.3, 1.0 / 3.0, -0.7),
        );

        let belief = Belief::known(odd, 0.1, 0.2).moved(
            crate::geometry::Twist {
                linear: nalgebra::Vector3::new(0.1, 0.2, 0.3),
                angular: nalgebra::Vector3::y() * 0.4,
            },
            &Matrix6::from_diagonal_element(1.0 / 7.0),
        );

        let state = State {
            room: Some(3),
            last: Some(Last {
                time_ns: -5,
                sequence: u64::MAX,
                latent: vec![-1.5; 20],
                odom: belief,
            }),
            keyframe: Some(Keyframe {
                sequence: 9,
                latent: vec![1.0 / 3.0; 20],
                odom: belief,
                place: Some(belief),
                told: None,
            }),
            initial: None,
            recent: vec![vec![0.1; 20], vec![-0.0; 20]],
            chain: Chain::Held {
                count: -1,
                confirmed: false,
            },
            candidate: Some(Candidate {
                room: 1,
                sequence: 8,
                latent: vec![0.5; 20],
                place: belief,
                agreed: 2,
            }),
            unseen: 7,
            unlooked: 2,
        };

        for state in [
            state,
            State::default(),
            State {
                chain: Chain::Lost { count: 4 },
                ..State::default()
            },
        ] {
            let bytes = SealedState::from(&state).encode_to_vec();
            let back = SealedState::decode(bytes.as_slice())
                .unwrap()
                .state()
                .unwrap();

            assert_eq!(back, state);

            // Equality takes -0 for 0.
            assert_eq!(SealedState::from(&back).encode_to_vec(), bytes);
        }
    }
}
