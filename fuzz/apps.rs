//! Fuzz targets of `evaluate` and `train` as a whole: a plan of the fixture with depth maps as a
//! perfect program would make them, of which one file is replaced by the fuzzer's. What is accepted
//! must give numbers.

use std::{
    fs,
    path::{Path, PathBuf},
};

use viewrank::{
    Hint, NoWatcher, Plan, Project, Settings, ViewCluster, backends,
    evaluate::{
        self, Evaluation, EvaluationInput, EvaluationOptions, MeasuredClusters, MeasuredProgress,
        MeasuredSurface,
    },
    learn::{self, Lesson, Numbers},
};
use viewrank_core::{
    method::visibility::{NOTHING, front},
    model::scene::ViewIndex,
};
use viewrank_io::{depthmaps, npy};

/// Targets: the command, and the file that is replaced.
pub const APPS: [&str; 6] = [
    "evaluate.npy",
    "evaluate.bin",
    "evaluate.report",
    "evaluate.clusters",
    "train.npy",
    "train.report",
];

const WIDTH: u32 = 80;
const HEIGHT: u32 = 60;

/// A planned project with its depth maps.
pub struct Finished {
    folder: tempfile::TempDir,
    plan: Plan,
    clusters: Vec<ViewCluster>,
}

impl Finished {
    pub fn new() -> Self {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let valley = Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/valley");
        let project = Project::open(&valley, None).expect("a project");
        let settings = Settings {
            backends: vec!["sgm".into()],
            // Of images 600 pixels wide.
            image_scale: Some(f64::from(WIDTH) / 600.0),
            ..Settings::default()
        };
        let plan = viewrank::plan(&project, &settings, &NoWatcher).expect("a plan");
        let clusters = plan.stages.clusters.clone();
        let finished = Self {
            folder,
            plan,
            clusters,
        };
        finished.write_all();
        finished
    }

    fn maps(&self) -> PathBuf {
        self.folder.path().join("maps")
    }

    fn name(&self, cluster: usize) -> &str {
        self.plan.stages.scene.name(self.clusters[cluster].key)
    }

    fn write_all(&self) {
        fs::create_dir_all(self.maps()).expect("a folder");
        for cluster in 0..self.clusters.len() {
            fs::write(
                self.maps().join(format!("{}.npy", self.name(cluster))),
                self.npy(cluster),
            )
            .expect("a file");
        }
        fs::write(
            self.maps().join("report.json"),
            self.valid("evaluate.report"),
        )
        .expect("a file");
    }

    fn depths(&self, cluster: usize) -> Vec<f32> {
        let (scene, surface, view): (_, _, ViewIndex) = (
            &self.plan.stages.scene,
            &self.plan.stages.surface,
            self.clusters[cluster].key,
        );
        let (camera, pose) = (scene.camera_of(view), &scene.view(view).cam_from_world);
        let depth = |(at, &triangle): (usize, &u32)| {
            if triangle == NOTHING {
                return 0.0;
            }
            let share = |at: u32, side: u32| (f64::from(at) + 0.5) / f64::from(side);
            let [x, y] = [
                share(at as u32 % WIDTH, WIDTH),
                share(at as u32 / WIDTH, HEIGHT),
            ];
            let pixel = [x * f64::from(camera.width), y * f64::from(camera.height)].into();
            let ray = camera.ray(&pixel).expect("a pinhole has a ray everywhere");
            let normal = pose.rotation * surface.area_normal(triangle);
            let corner = pose.camera_from_world(&surface.corners(triangle)[0]);
            (normal.dot(&corner.coords) / normal.dot(&ray) * ray.z) as f32
        };
        front(scene, surface, view, [WIDTH, HEIGHT], 0..HEIGHT)
            .iter()
            .enumerate()
            .map(depth)
            .collect()
    }

    fn npy(&self, cluster: usize) -> Vec<u8> {
        npy::write(&[HEIGHT as usize, WIDTH as usize], self.depths(cluster))
    }

    /// The valid contents of a target's file.
    pub fn valid(&self, target: &str) -> Vec<u8> {
        let scene = &self.plan.stages.scene;
        match target {
            "evaluate.bin" => {
                let head = format!("{WIDTH}&{HEIGHT}&1&").into_bytes();
                head.into_iter()
                    .chain(self.depths(0).into_iter().flat_map(f32::to_le_bytes))
                    .collect()
            }
            "evaluate.clusters" => evaluate::clusters::write(&self.clusters, scene).into_bytes(),
            "evaluate.report" | "train.report" => {
                let row = |cluster: &ViewCluster| {
                    let partner = |(i, &p): (usize, &ViewIndex)| serde_json::json!({"name": scene.name(p), "matched": i != 1});
                    let partners: Vec<_> =
                        cluster.partners.iter().enumerate().map(partner).collect();
                    serde_json::json!({"key": scene.name(cluster.key), "partners": partners})
                };
                let rows: Vec<_> = self.clusters.iter().map(row).collect();
                serde_json::json!({ "clusters": rows })
                    .to_string()
                    .into_bytes()
            }
            _ => self.npy(0),
        }
    }

    /// Runs the command with the target's file replaced; true if it has a result.
    pub fn run(&self, target: &str, data: &[u8]) -> bool {
        let name = match target.split_once('.').expect("command and file").1 {
            "npy" => format!("{}.npy", self.name(0)),
            "bin" => format!("{}.geometric.bin", self.name(0)),
            "report" => "report.json".into(),
            _ => "clusters.txt".into(),
        };
        let file = self.maps().join(&name);
        let kept = fs::read(&file).ok();
        // One map for a view, whatever its format.
        let other = self.maps().join(format!("{}.npy", self.name(0)));
        if target == "evaluate.bin" {
            fs::remove_file(&other).expect("the valid map");
        }
        fs::write(&file, data).expect("a file");
        let has_result = if target.starts_with("train") {
            self.train()
        } else {
            self.evaluate(target, &file)
        };
        match kept {
            Some(bytes) => fs::write(&file, bytes).expect("a file"),
            None => fs::remove_file(&file).expect("a file"),
        }
        if target == "evaluate.bin" {
            fs::write(&other, self.npy(0)).expect("a file");
        }
        has_result
    }

    fn evaluate(&self, target: &str, file: &Path) -> bool {
        let stages = &self.plan.stages;
        let clusters = match target {
            "evaluate.clusters" => match told(evaluate::clusters::read(file, &stages.scene)) {
                Some(clusters) => clusters,
                None => return false,
            },
            _ => self.clusters.clone(),
        };
        let maps = self.maps();
        let Some(run) = told(MeasuredClusters::new(
            &EvaluationInput::new(stages, &clusters, &maps, None),
            &NoWatcher,
        )) else {
            return false;
        };
        let model = stages.model();
        let reached = MeasuredSurface::new(&model, &run);
        let so_far = MeasuredProgress::new(stages, &run);
        let cells = told(evaluate::cells::incidence(
            stages, &run, &maps, None, &NoWatcher,
        ));
        let options = EvaluationOptions {
            all_maps: stages.clusters.len(),
            objective: &stages.objective,
            pilot: stages.pilot.as_ref(),
            cells: cells.expect("maps that were just read"),
            baselines: false,
            so_far,
            clouds: None,
            half: None,
        };
        let evaluation = Evaluation::new(&model, &run, &reached, &options, &NoWatcher)
            .expect("tables in memory");
        let share = |share: f64| (0.0..=1.0 + 1e-9).contains(&share);
        assert!(
            evaluation.curve.real.iter().all(|&real| share(real)),
            "{:?}",
            evaluation.curve.real
        );
        assert!(run.real.values.iter().all(|f| (0.0..=1.0).contains(f)));
        assert!(!evaluate::page(&evaluation, "t").contains("NaN"));
        true
    }

    fn train(&self) -> bool {
        let stages = &self.plan.stages;
        let Some(found) = told(
            depthmaps::find(&self.maps(), &stages.scene).and_then(|found| found.into_complete()),
        ) else {
            return false;
        };
        let Some(clusters) = told(evaluate::tried(
            &self.maps(),
            &found.maps,
            &stages.scene,
            &self.clusters,
        )) else {
            return false;
        };
        let lesson = Lesson {
            model: stages.model(),
            clusters,
            maps: found.maps,
        };
        let planning = &backends::by_name("sgm").expect("a backend").planning;
        let before = Numbers {
            min_matches: planning.confidence.min_matches,
            photometric: planning.photometric,
        };
        let Some(fitted) = told(learn::train(&[lesson], before, &NoWatcher)) else {
            return false;
        };
        let Numbers { photometric, .. } = fitted.numbers;
        let numbers = [
            photometric.agree,
            photometric.differ,
            photometric.full_agreement,
            fitted.after.brier,
        ];
        assert!(
            numbers.iter().all(|x| (0.0..=1.0).contains(x)),
            "{numbers:?}"
        );
        true
    }
}

/// Errors must have something to say.
fn told<T>(result: Result<T, impl Hint>) -> Option<T> {
    result
        .inspect_err(|error| assert!(!error.to_string().is_empty()))
        .ok()
}
