//! OdometryService.Track.

pub mod token;
