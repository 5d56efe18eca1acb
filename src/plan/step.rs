//! A stage of the method with what every plan adds to it: its time, cancellation, and the result
//! that an earlier plan has left for the same inputs.

use serde::{Serialize, de::DeserializeOwned};

use super::{
    Memory, PlanError, Timings,
    cached::{self, Filed},
};
use crate::{
    base::progress::{Stage, Watcher},
    io::cache::CacheFile,
};

/// A stage with its inputs.
pub(super) trait Step {
    /// The stage that its time counts for.
    const STAGE: Stage;
    /// Small results, beside those that are packed.
    type Facts: Serialize + DeserializeOwned;
    type Output;

    /// Returns where the result is cached, by the fingerprint of all inputs.
    fn file(&self) -> CacheFile;

    /// Makes sense of what the file holds; `None` if it is no result for these inputs.
    fn unpack(&self, facts: Self::Facts, bytes: &[u8]) -> Option<Self::Output>;

    /// `memory`: its forecast comes before the computation.
    fn compute(self, memory: &mut Memory, watcher: &dyn Watcher)
    -> Result<Self::Output, PlanError>;
}

/// A plan being made.
pub(super) struct Run<'a> {
    pub timings: &'a mut Timings,
    pub memory: Memory,
    pub watcher: &'a dyn Watcher,
}

impl Run<'_> {
    /// Returns the result of an earlier plan for the same inputs, else computes it.
    pub fn step<S: Step>(&mut self, step: S) -> Result<Filed<S::Output>, PlanError> {
        self.watcher.check()?;
        self.timings.time(S::STAGE, || {
            cached::read(step.file(), |facts, bytes| step.unpack(facts, bytes))
                .or_compute(|| step.compute(&mut self.memory, self.watcher))
        })
    }
}
