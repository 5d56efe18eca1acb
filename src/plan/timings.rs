//! How long each stage took: for `timings.json` and the question whether planning was worth it.

use std::time::Instant;

use serde::{Serialize, Serializer, ser::SerializeMap};

use crate::base::progress::Stage;

/// Seconds of wall time per stage, in the order in which they ran, and from start to end.
#[derive(Clone, Debug)]
pub struct Timings {
    start: Instant,
    stages: Vec<(Stage, f64)>,
    total: f64,
}

impl Timings {
    pub fn start() -> Self {
        Self { start: Instant::now(), stages: Vec::new(), total: 0.0 }
    }

    /// Runs a stage and notes its time; a stage that ran before took both times.
    pub fn time<T>(&mut self, stage: Stage, run: impl FnOnce() -> T) -> T {
        let start = Instant::now();
        let result = run();
        let seconds = start.elapsed().as_secs_f64();
        match self.stages.iter_mut().find(|(known, _)| *known == stage) {
            Some((_, before)) => *before += seconds,
            None => self.stages.push((stage, seconds)),
        }
        result
    }

    /// Everything is done.
    pub fn end(&mut self) {
        self.total = self.start.elapsed().as_secs_f64();
    }

    /// From start to end, seconds; more than the stages together.
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
