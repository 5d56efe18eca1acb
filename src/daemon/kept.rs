//! Cache of plans with all their tables, kept between measurements of a project's depth maps.

use std::path::{Path, PathBuf};

use super::settle::Fingerprint;
use crate::plan::Plan;

/// The most recently used plans, up to a size.
#[derive(Debug)]
pub struct PlanCache {
    max_bytes: u64,
    /// Least recently used first.
    plans: Vec<CachedPlan>,
}

#[derive(Debug)]
struct CachedPlan {
    project: PathBuf,
    fingerprint: Fingerprint,
    plan: Plan,
}

impl PlanCache {
    pub fn new(max_bytes: u64) -> Self {
        Self {
            max_bytes,
            plans: Vec::new(),
        }
    }

    /// Returns a copy of the plan that was made from this input.
    pub fn get(&mut self, project: &Path, fingerprint: &Fingerprint) -> Option<Plan> {
        let at = self
            .plans
            .iter()
            .position(|kept| kept.project == project && kept.fingerprint == *fingerprint)?;
        let kept = self.plans.remove(at);
        let plan = kept.plan.clone();
        self.plans.push(kept);
        Some(plan)
    }

    /// Replaces the project's plan, and drops the least recently used plans beyond the size limit.
    pub fn put(&mut self, project: &Path, fingerprint: Fingerprint, plan: &Plan) {
        self.forget(project);
        if plan.stages.memory.disk > 0 {
            // Tables on disk would fill it unnoticed.
            return;
        }
        self.plans.push(CachedPlan {
            project: project.into(),
            fingerprint,
            plan: plan.clone(),
        });
        // The new plan goes too, if it is too large alone.
        while self
            .plans
            .iter()
            .map(|kept| kept.plan.stages.bytes())
            .sum::<u64>()
            > self.max_bytes
        {
            self.plans.remove(0);
        }
    }

    /// Drops the plan of a project.
    pub fn forget(&mut self, project: &Path) {
        self.plans.retain(|kept| kept.project != project);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::apps::planning;
    use crate::{
        base::progress::NoWatcher,
        config::Settings,
        io::{
            formats::{colmap::ColmapModel, colmap_bin},
            project::Project,
        },
        method::synthetic::Town,
        model::camera::{Camera, CameraModel},
    };

    #[test]
    fn the_least_recently_used_plan_is_dropped_first() {
        let camera = Camera::new(
            1,
            CameraModel::Pinhole,
            400,
            300,
            vec![320.0, 320.0, 200.0, 150.0],
        )
        .expect("a camera");
        let town = Town {
            grid: 3,
            points: 300,
            tilt: None,
            side: 40.0,
            boxes: 1,
            ..Town::new(camera)
        };
        let folder = tempfile::tempdir().expect("a temporary folder");
        for (name, bytes) in colmap_bin::write(&ColmapModel::from_scene(&town.scene())) {
            std::fs::write(folder.path().join(name), bytes).expect("a file");
        }
        let project = Project::open(folder.path(), None).expect("a model");
        let plan = planning::plan(&project, &Settings::default(), &NoWatcher).expect("a plan");
        let print =
            |text: &str| serde_json::from_value::<Fingerprint>(text.into()).expect("a string");
        let [a, b, c] = ["a", "b", "c"].map(Path::new);
        let mut kept = PlanCache::new(2 * plan.stages.bytes());
        kept.put(a, print("1"), &plan);
        kept.put(b, print("1"), &plan);
        assert!(kept.get(a, &print("1")).is_some());
        assert!(kept.get(a, &print("2")).is_none(), "another input");
        kept.put(c, print("1"), &plan);
        assert!(kept.get(b, &print("1")).is_none());
        assert!(kept.get(a, &print("1")).is_some() && kept.get(c, &print("1")).is_some());
        PlanCache::new(0).put(a, print("1"), &plan);
    }
}
