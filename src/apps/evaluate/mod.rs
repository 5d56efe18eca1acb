//! Method 8: what finished depth maps really reach, against what was predicted and against other choices.
//!
//! A [`MeasuredClusters`] is a folder of depth maps of some view clusters, measured: `measure` holds a map against its reference, `matched` says which
//! partners were really used. [`orders`] and [`rules`] are the choices of others.

mod baselines;
pub mod clusters;
mod compare;
pub mod curve;
mod evaluation;
mod matched;
mod measure;
mod missing;
pub mod orders;
mod page;
pub mod rules;
mod run;
pub mod tables;

#[cfg(test)]
mod tests;

pub use compare::{Choice, Compared, choices, compare};
pub use evaluation::{Evaluation, EvaluationOptions};
pub use matched::{ReportError, tried};
pub use measure::Quality;
pub use missing::{MeasuredSurface, Missing};
pub use page::page;
pub use run::{EvaluateError, EvaluationInput, MeasuredClusters};
