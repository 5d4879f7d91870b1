//! The laboratory of [seese3](https://docs.rs/seese3): experiments for researchers, not used by the
//! service.
//!
//! The modules are listed from the lowest layer up. Each uses only those listed before it; a test
//! enforces this.
//!
//! | module | what |
//! | --- | --- |
//! | [`formulations`] | the paper's alternatives A to D to the adapter |
//! | [`probes`] | probes M1 to M3 of the SE(3) information in features; M4 trains an adapter |
//! | [`theory`] | numeric checks of the paper's theorems |
//! | [`experiments`] | experiments over rooms, with their result types |
//! | [`report`] | tables, JSON, pictures and documents of the results |
//! | [`reproduction`] | the paper's tables and figures on given rooms, as one report |
//!
//! This crate reads and writes no files; the program does.

pub mod formulations;
pub mod probes;
pub mod theory;
pub mod experiments;
pub mod report;
pub mod reproduction;
