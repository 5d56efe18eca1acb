//! Wall time of each stage, for `timings.json` and for comparing the cost of planning with the
//! matching time that it saves.

use std::time::Instant;

use serde::{Serialize, Serializer, ser::SerializeMap};

use crate::base::progress::Stage;

/// Wall time in seconds, per stage in the order of execution, and in total.
#[derive(Clone, Debug)]
pub struct Timings {
    start: Instant,
    stages: Vec<(Stage, f64)>,
    total: f64,
}

impl Timings {
    pub fn start() -> Self {
        Self {
            start: Instant::now(),
            stages: Vec::new(),
            total: 0.0,
        }
    }

    /// Runs a stage and records its time; a stage that runs again accumulates.
    pub fn time<T>(&mut self, stage: Stage, run: impl FnOnce() -> T) -> T {
        let start = Instant::now();
        let result = run();
        self.add(stage, start.elapsed().as_secs_f64());
        result
    }

    /// Runs work that times stages of its own; what they leave of its time counts to `stage`.
    pub fn time_rest<T>(&mut self, stage: Stage, run: impl FnOnce(&mut Self) -> T) -> T {
        let (start, before) = (Instant::now(), self.sum());
        let result = run(self);
        self.add(stage, start.elapsed().as_secs_f64() - (self.sum() - before));
        result
    }

    fn sum(&self) -> f64 {
        self.stages.iter().map(|(_, seconds)| seconds).sum()
    }

    fn add(&mut self, stage: Stage, seconds: f64) {
        match self.stages.iter_mut().find(|(known, _)| *known == stage) {
            Some((_, before)) => *before += seconds,
            None => self.stages.push((stage, seconds)),
        }
    }

    /// Stops the clock.
    pub fn end(&mut self) {
        self.total = self.start.elapsed().as_secs_f64();
    }

    /// Seconds from start to end, more than the sum of the stages.
    pub fn total(&self) -> f64 {
        self.total
    }
}

impl Serialize for Timings {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(Some(self.stages.len() + 1))?;
        for (stage, seconds) in &self.stages {
            map.serialize_entry(stage, seconds)?;
        }
        map.serialize_entry("total", &self.total())?;
        map.end()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stage_within_another_counts_once() {
        let mut timings = Timings::start();
        let work = || (0..200_000u64).map(std::hint::black_box).sum::<u64>();
        timings.time_rest(Stage::Partners, |timings| {
            timings.time(Stage::Surface, work)
        });
        timings.time(Stage::Surface, work);
        timings.end();
        let stages: Vec<Stage> = timings.stages.iter().map(|(stage, _)| *stage).collect();
        assert_eq!(stages, [Stage::Surface, Stage::Partners]);
        assert!(timings.sum() <= timings.total(), "{timings:?}");
    }
}
