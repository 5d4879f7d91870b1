//! Whether a stream's frames hang together, and with the room: what tells a lost camera from one
//! that explores.

/// Frames in a row that must look like the room before a lost stream is not lost any more.
pub const REGAINED: u32 = 5;
/// Frames that must look like the room, two for each that does not, before a new chain is beyond
/// doubt.
const CONFIRMED: i32 = 20;

/// What the frames so far say.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Chain {
    /// No frame has come.
    #[default]
    Fresh,
    /// Each frame follows from the one before, back to some that looked like the room.
    Held {
        /// Frames that looked like the room, less two for each that did not; no longer counted once
        /// confirmed.
        count: i32,
        /// Whether it is beyond doubt that this is the room: then frames that look unlike it are of
        /// places not mapped.
        confirmed: bool,
    },
    /// The frames do not look like the room, or do not follow from one another.
    Lost {
        /// Frames in a row that look like the room all the same.
        count: u32,
    },
}

/// How a frame looks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Look {
    /// Whether it looks like the room.
    pub on_map: bool,
    /// Whether hardly a frame of another room looks as much like it.
    pub sure: bool,
    /// Whether it shows what no camera sees that was just where the frames before were.
    pub jumped: bool,
    /// Whether so many frames are missing before it that a jump could not be told.
    pub gap: bool,
}

impl Chain {
    /// Before the first frame, in a room that is known to be the right one or not.
    pub fn beginning(known: bool) -> Self {
        if known {
            Self::Held {
                count: CONFIRMED,
                confirmed: true,
            }
        } else {
            Self::Fresh
        }
    }

    /// After a frame.
    #[must_use]
    pub fn after(self, look: Look) -> Self {
        let Look {
            on_map,
            sure,
            jumped,
            gap,
        } = look;

        match self {
            Self::Held { .. } if jumped => Self::Lost { count: 0 },
            // What happened in between was not seen.
            Self::Held { .. } if gap => match on_map {
                true => Self::Held {
                    count: 1,
                    confirmed: false,
                },
                false => Self::Lost { count: 0 },
            },
            Self::Held {
                confirmed: true, ..
            } => self,
            Self::Held { count, .. } => match if on_map { count + 1 } else { count - 2 } {
                ..0 => Self::Lost { count: 0 },
                count => Self::Held {
                    count,
                    confirmed: count >= CONFIRMED,
                },
            },
            Self::Fresh if on_map => Self::Held {
                count: 1,
                confirmed: false,
            },
            Self::Fresh => Self::Lost { count: 0 },
            Self::Lost { .. } if jumped || !sure => Self::Lost { count: 0 },
            Self::Lost { count } if count + 1 >= REGAINED => Self::Held {
                count: 0,
                confirmed: false,
            },
            Self::Lost { count } => Self::Lost { count: count + 1 },
        }
    }

    /// Whether the camera is lost.
    pub fn is_lost(self) -> bool {
        matches!(self, Self::Lost { .. })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(from: Chain, frames: &[(bool, bool)]) -> Vec<bool> {
        let mut chain = from;
        frames
            .iter()
            .map(|&(on_map, jumped)| {
                chain = chain.after(Look {
                    on_map,
                    sure: on_map,
                    jumped,
                    gap: false,
                });

                chain.is_lost()
            })
            .collect()
    }

    /// Oracle: the rules by hand.
    #[test]
    fn a_known_camera_may_explore_but_not_jump() {
        assert_eq!(
            run(Chain::beginning(true), &[(false, false); 50]),
            [false; 50]
        );

        assert_eq!(
            run(
                Chain::beginning(true),
                &[(true, false), (false, true), (false, false)]
            ),
            [false, true, true]
        );
    }

    /// Oracle: the rules by hand.
    #[test]
    fn an_unknown_camera_has_to_look_like_the_room() {
        assert_eq!(run(Chain::Fresh, &[(false, false); 3]), [true; 3]);

        // One frame that looks like it gives a doubtful chain; the next that does not breaks it.
        assert_eq!(
            run(
                Chain::Fresh,
                &[(true, false), (false, false), (true, false)]
            ),
            [false, true, true]
        );

        // Five in a row regain it.
        let frames = [&[(false, false)][..], &[(true, false); 6]].concat();
        assert_eq!(
            run(Chain::Fresh, &frames),
            [true, true, true, true, true, false, false]
        );

        // A gap has to be bridged by what is seen behind it.
        let gap = |on_map| {
            Chain::beginning(true).after(Look {
                on_map,
                sure: on_map,
                jumped: false,
                gap: true,
            })
        };

        assert!(
            gap(false).is_lost()
                && gap(true)
                    == Chain::Held {
                        count: 1,
                        confirmed: false
                    }
        );

        // Twenty confirm it: then it may explore.
        let frames = [&[(true, false); 20][..], &[(false, false); 9]].concat();
        assert!(run(Chain::Fresh, &frames).iter().all(|lost| !lost));
    }
}
