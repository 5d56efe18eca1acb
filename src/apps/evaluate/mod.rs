//! Evaluates finished depth maps (method 8): compares the measured fulfilment with the prediction
//! and with other choices.
//!
//! [`MeasuredClusters`] holds the measured depth maps of one folder: `measure` compares a map with
//! its reference, `matched` reads which partners were really matched. [`orders`] are those that the
//! plan's is compared with.

pub mod baselines;
pub mod cells;
mod clouds;
pub mod clusters;
pub mod curve;
mod evaluation;
mod half_size;
mod matched;
mod measure;
mod missing;
mod of_plan;
pub mod orders;
mod page;
mod run;
mod size;
mod so_far;
pub mod tables;

#[cfg(test)]
mod tests;

pub use clouds::{CloudComparison, Within};
pub use evaluation::{Evaluation, EvaluationOptions, QualityRow};
pub use half_size::HalfSize;
pub use matched::{MatcherReportError, tried};
pub use measure::Quality;
pub(super) use measure::measure;
pub use missing::{MeasuredSurface, Missing};
pub use page::page;
pub use run::{EvaluateError, EvaluationInput, MeasuredClusters};
pub use size::{MapSize, other_sizes_in_words};
pub use so_far::MeasuredProgress;
