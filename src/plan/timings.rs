//! How long each stage took: for `timings.json` and the question whether planning was worth it.

use std::time::Instant;

use serde::{Serialize, Serializer, ser::SerializeMap};

use crate::progress::Stage;

/// Seconds of wall time per stage, in the order in which they ran.
#[derive(Clone, Debug, Default)]
pub struct Timings(Vec<(Stage, f64)>);

impl Timings {
    /// Runs a stage and notes its time.
    pub fn time<T>(&mut self, stage: Stage, run: impl FnOnce() -> T) -> T {
        let start = Instant::now();
        let result = run();
        self.0.push((stage, start.elapsed().as_secs_f64()));
        result
    }

    /// Of all stages so far, seconds.
    pub fn total(&self) -> f64 {
        self.0.iter().map(|(_, seconds)| seconds).sum()
    }
}

impl Serialize for Timings {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(Some(self.0.len() + 1))?;
        for (stage, seconds) in &self.0 {
            map.serialize_entry(stage, seconds)?;
        }
        map.serialize_entry("total", &self.total())?;
        map.end()
    }
}
