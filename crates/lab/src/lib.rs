//! The laboratory of [seese3](https://docs.rs/seese3): what researchers run, and the service never
//! needs.
//!
//! The modules are listed from the lowest layer up: each uses only those listed before it, and a test
//! enforces it.
//!
//! | module | what |
//! | --- | --- |
//! | [`formulations`] | the paper's alternatives A to D to the adapter |
//! | [`probes`] | M1 to M3: how much of SE(3) features hold; M4 is the training of an adapter |
//! | [`theory`] | the paper's theorems as numeric checks |
//! | [`experiments`] | what is computed over rooms, and its result types |
//! | [`report`] | tables, JSON, pictures and documents of those results |
//! | [`reproduction`] | the paper's tables and figures on given rooms, as one report |
//!
//! Nothing here reads or writes files; the program does.

pub mod formulations;
pub mod probes;
pub mod theory;
pub mod experiments;
pub mod report;
pub mod reproduction;
