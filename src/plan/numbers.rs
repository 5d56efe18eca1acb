//! What a plan needs to know of the MVS program that it is made for.

use serde::Serialize;

use crate::{method::confidence::PairConfidence, model::cluster::Gate};

/// What a backend contributes to planning, each with where it was measured.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct PlanningNumbers {
    /// Method 7.1.
    pub gate: Gate,
    /// Method 7.2.
    pub confidence: PairConfidence,
    /// Depth maps that must see a triangle (m, method 5.2).
    pub support: u32,
    /// The data sets that the numbers were measured on, or whose they are instead; a few words.
    pub measured: &'static str,
    /// Where the numbers and the gate come from, and why.
    pub source: &'static str,
}

/// The MVS program that a plan is made for.
#[derive(Clone, Copy, Debug)]
pub struct Matcher {
    /// As typed behind `--backend`.
    pub name: &'static str,
    pub numbers: PlanningNumbers,
}
