//! The service over a real server on a free port, asked through the real client.

#[path = "../support/mod.rs"]
mod support;

mod answers;
mod goals;
mod harness;
mod images;
mod lifecycle;
mod navigators;
mod refusals;
mod tracking;
