//! What is written for each backend, read back by small readers of the other side's grammars. Tests
//! that guard against a trap of a backend are named after the trap.

mod acm;
mod colmap;
mod lists;
mod mve;
mod mvsnet;
mod openmvs;
mod others;
mod pmvs;
mod sure;

use std::{collections::BTreeMap, path::PathBuf, sync::OnceLock};

use viewrank::backends::{BACKENDS, BackendError, Export, ExportOptions, Selection, by_name};
use viewrank_core::{
    method::synthetic::Town,
    model::{
        camera::{Camera, CameraModel},
        cluster::{MapScale, RankedCluster},
        scene::{Scene, ViewIndex},
    },
};
use viewrank_io::{
    output::Contents,
    project::{ImageFaults, ModelFormat, ModelLocation, Project, ProjectKind},
};

/// A scene with chosen clusters, in a project that exists nowhere.
pub struct Fixture {
    pub scene: Scene,
    pub clusters: Vec<RankedCluster>,
    pub project: Project,
    pub image_scale: f64,
    pub own_size: bool,
    pub image_faults: ImageFaults,
    pub test_every: Option<u32>,
}

/// Square pixels would hide a width taken for a height.
pub fn pinhole() -> Camera {
    Camera::new(
        7,
        CameraModel::Pinhole,
        640,
        480,
        vec![510.0, 500.0, 330.25, 229.5],
    )
    .unwrap()
}

impl Fixture {
    /// Four key views with the `k` views that share most points; ids with gaps and out of order,
    /// names with folders and blanks.
    pub fn new(k: usize) -> Self {
        static TOWN: OnceLock<Scene> = OnceLock::new();
        let mut scene = TOWN
            .get_or_init(|| {
                Town {
                    points: 1500,
                    ..Town::new(pinhole())
                }
                .scene()
            })
            .clone();
        let count = scene.views.len() as u32;
        for (i, view) in (0..count).zip(&mut scene.views) {
            view.name = format!("flight {}/img {i:03}.jpg", i / 20);
            view.image_id = 1000 + (i * 37) % count * 3;
            view.file_position = (i * 37) % count;
        }
        let mut fixture = Self {
            scene,
            clusters: Vec::new(),
            project: project(),
            image_scale: 1.0,
            own_size: false,
            image_faults: ImageFaults::default(),
            test_every: None,
        };
        fixture.choose(&[12, 3, 30, 24], k);
        fixture
    }

    /// Key views in rank order, each with the `k` views that share most points.
    pub fn choose(&mut self, keys: &[u32], k: usize) {
        let cluster = |(i, &key): (usize, &u32)| RankedCluster {
            key: ViewIndex(key),
            partners: self.connected(ViewIndex(key)).into_iter().take(k).collect(),
            scale: MapScale::Full,
            share: (i + 1) as f64 / 10.0,
        };
        self.clusters = keys.iter().enumerate().map(cluster).collect();
    }

    /// The views that share points with this one, most first.
    pub fn connected(&self, key: ViewIndex) -> Vec<ViewIndex> {
        let mut shared = vec![0; self.scene.views.len()];
        for &p in self.scene.view_points().observed_by(key) {
            self.scene
                .track_views(p)
                .iter()
                .for_each(|v| shared[v.index()] += 1);
        }
        shared[key.index()] = 0;
        let mut views: Vec<_> = self
            .scene
            .view_indices()
            .filter(|v| shared[v.index()] > 0)
            .collect();
        views.sort_by_key(|v| std::cmp::Reverse(shared[v.index()]));
        views
    }

    /// The views that share points with another one.
    pub fn matchable(&self) -> Vec<ViewIndex> {
        self.scene
            .view_indices()
            .filter(|v| !self.connected(*v).is_empty())
            .collect()
    }

    pub fn name(&self, view: ViewIndex) -> &str {
        self.scene.name(view)
    }

    /// Names of key view and partners, in rank order.
    pub fn named(&self) -> Vec<(String, Vec<String>)> {
        let name = |v: &ViewIndex| self.name(*v).to_owned();
        self.clusters
            .iter()
            .map(|c| (name(&c.key), c.partners.iter().map(name).collect()))
            .collect()
    }

    pub fn try_export(
        &self,
        backend: &str,
        options: &ExportOptions,
    ) -> Result<Export, BackendError> {
        let backend = by_name(backend).unwrap();
        let selection = Selection {
            project: &self.project,
            scene: &self.scene,
            clusters: &self.clusters,
            image_scale: self.image_scale,
            own_size: self.own_size,
            planned_for: backend.name,
            image_faults: &self.image_faults,
            test_every: self.test_every,
        };
        backend.export(&selection, options)
    }

    pub fn export(&self, backend: &str) -> Files {
        self.export_with(backend, &ExportOptions::default())
    }

    pub fn export_with(&self, backend: &str, options: &ExportOptions) -> Files {
        Files(self.try_export(backend, options).unwrap())
    }
}

/// A project whose model is not on the disk, so that reduced models are made from the scene.
pub fn project() -> Project {
    Project {
        root: "/nowhere".into(),
        home: "/nowhere".into(),
        named: "/nowhere".into(),
        kind: ProjectKind::BareModel,
        model: ModelLocation::new(ModelFormat::OpenMvs, "/nowhere/scene.mvs"),
        model_is_named: false,
        other_models: Vec::new(),
        images: Some("/nowhere/images".into()),
        originals: None,
        dense_workspace: None,
        model_stamps: Vec::new(),
    }
}

/// An export with its files at hand.
pub struct Files(pub Export);

impl Files {
    pub fn names(&self) -> Vec<&str> {
        self.0.files.files.keys().map(String::as_str).collect()
    }

    pub fn bytes(&self, path: &str) -> &[u8] {
        match &self.0.files.files[path] {
            Contents::Bytes(bytes) | Contents::Script(bytes) => bytes,
            other => panic!("{path} is {other:?}"),
        }
    }

    pub fn text(&self, path: &str) -> &str {
        std::str::from_utf8(self.bytes(path)).unwrap()
    }

    pub fn lines(&self, path: &str) -> Vec<&str> {
        self.text(path).lines().collect()
    }

    /// Where a link leads to.
    pub fn link(&self, path: &str) -> PathBuf {
        match &self.0.files.files[path] {
            Contents::Link { file, .. } => file.clone(),
            other => panic!("{path} is {other:?}"),
        }
    }

    pub fn is_folder(&self, path: &str) -> bool {
        matches!(self.0.files.files.get(path), Some(Contents::Folder))
    }

    /// Is that one of the things that the export says it will not do?
    pub fn says(&self, what: &str) -> bool {
        let record = &self.0.record;
        record
            .not_honoured
            .iter()
            .chain(&record.warnings)
            .any(|line| line.contains(what))
    }

    pub fn json(&self, path: &str) -> serde_json::Value {
        serde_json::from_slice(self.bytes(path)).unwrap()
    }
}

/// Words of the text as numbers.
pub fn numbers(text: &str) -> Vec<f64> {
    text.split_whitespace()
        .map(|word| word.parse().unwrap())
        .collect()
}

#[test]
fn every_backend_takes_the_fixture_and_says_what_it_wrote() {
    let mut fixture = Fixture::new(3);
    // MicMac knows neither folders nor blanks.
    for (i, view) in fixture.scene.views.iter_mut().enumerate() {
        view.name = format!("img{i:03}.jpg");
    }
    for backend in viewrank::backends::BACKENDS {
        let files = fixture.export(backend.name);
        let record = &files.0.record;
        assert_eq!(record.backend, backend.name);
        assert_eq!(record.clusters.len(), 4);
        assert!(
            !record.made_for.is_empty() && !record.way.is_empty() && !record.fusion.is_empty(),
            "{}",
            backend.name
        );
        assert!(
            // Lists for whatever program takes them.
            !record.commands.is_empty() || ["images", "pairs"].contains(&backend.name),
            "{}",
            backend.name
        );
        let notes = files
            .names()
            .into_iter()
            .find(|n| n.ends_with("export.json"))
            .unwrap()
            .to_owned();
        let read: viewrank::backends::ExportRecord =
            serde_json::from_slice(files.bytes(&notes)).unwrap();
        assert_eq!(&read, record, "{}", backend.name);
        let partly = [
            backend.capabilities.partners,
            backend.capabilities.key_subset,
            backend.capabilities.order,
        ];
        if partly.contains(&viewrank::backends::Honours::No) {
            assert!(
                !record.not_honoured.is_empty(),
                "{} says what it does not honour",
                backend.name
            );
        }
        let outside = files
            .names()
            .into_iter()
            .find(|n| n.starts_with('/') || n.split('/').any(|p| p == ".."))
            .map(str::to_owned);
        assert_eq!(outside, None);
        if let Some(runner) = &record.runner {
            assert!(matches!(files.0.files.files[runner], Contents::Script(_)));
        }
    }
}

#[test]
fn distorted_images_are_refused_with_the_command_that_makes_them() {
    let mut fixture = Fixture::new(3);
    fixture.scene.cameras = vec![
        Camera::new(
            7,
            CameraModel::SimpleRadial,
            640,
            480,
            vec![500.0, 320.0, 240.0, 0.01],
        )
        .unwrap(),
    ];
    let foreign = fixture
        .try_export("openmvs", &ExportOptions::default())
        .unwrap_err();
    assert!(
        !viewrank_core::base::error::Hint::hint(&foreign)
            .unwrap()
            .to_string()
            .contains("colmap"),
        "COLMAP does not read that model"
    );
    fixture.project.model.format = ModelFormat::ColmapBinary;
    for backend in [
        "openmvs",
        "colmap",
        "mvsnet",
        "pmvs",
        "mve",
        "gipuma",
        "alicevision",
        "sure",
    ] {
        let error = fixture
            .try_export(backend, &ExportOptions::default())
            .unwrap_err();
        let hint = viewrank_core::base::error::Hint::hint(&error)
            .unwrap()
            .to_string();
        assert!(
            error.to_string().contains("SIMPLE_RADIAL")
                && hint.contains("viewrank undistort /nowhere")
                && hint.contains("image_undistorter --image_path /nowhere"),
            "{backend}: {error}"
        );
    }
    fixture.project.model.format = ModelFormat::OpenMvs;
    assert!(fixture.export("splat").says("image_undistorter"));
}

/// What is put into scripts when the export is complete.
#[test]
fn no_script_lacks_what_belongs_into_it() {
    let fixture = Fixture::new(4);
    let mut scripts = 0;
    for backend in BACKENDS {
        let Ok(export) = fixture.try_export(backend.name, &ExportOptions::default()) else {
            continue;
        };
        for (name, contents) in &export.files.files {
            let Contents::Script(script) = contents else {
                continue;
            };
            scripts += 1;
            let script = String::from_utf8_lossy(script);
            let is_left = |line: &str| line.trim_matches(['#', ' ']).starts_with('@');
            let left = script
                .lines()
                .find(|line| is_left(line) && line.ends_with('@'));
            assert_eq!(left, None, "{name} of {}", backend.name);
        }
    }
    assert!(scripts > 8);
}

/// The sizes that the programs take without an option, and that of a plan for another program where
/// the user has set none.
#[test]
fn without_image_scale_each_program_takes_its_own_size() {
    let own = |backend: &str, width: u64, height: u64| {
        let camera = Camera::new(
            1,
            CameraModel::Pinhole,
            width,
            height,
            vec![500.0, 500.0, 1.0, 1.0],
        )
        .unwrap();
        let size = (by_name(backend).unwrap().own_scale)(&camera) * f64::from(camera.width);
        size.round() as u32
    };
    for (backend, sizes) in [
        (
            "openmvs",
            [
                (640, 640),
                (1200, 1200),
                (1280, 640),
                (4000, 2000),
                (8000, 2560),
            ],
        ),
        (
            "odm",
            [
                (640, 640),
                (1200, 1200),
                (1280, 640),
                (4000, 1000),
                (8000, 1000),
            ],
        ),
        (
            "mve",
            [
                (640, 640),
                (1200, 1200),
                (1600, 800),
                (4000, 1000),
                (8000, 1000),
            ],
        ),
        (
            "alicevision",
            [
                (640, 320),
                (1200, 600),
                (1280, 640),
                (4000, 2000),
                (8000, 4000),
            ],
        ),
        (
            "colmap",
            [
                (640, 640),
                (1200, 1200),
                (1280, 1280),
                (4000, 4000),
                (8000, 8000),
            ],
        ),
    ] {
        for (width, size) in sizes {
            assert_eq!(
                own(backend, width, width * 3 / 4),
                size,
                "{backend}, {width}"
            );
        }
    }
    let mut fixture = Fixture::new(3);
    (fixture.image_scale, fixture.own_size) = (0.25, true);
    let scale = |fixture: &Fixture, backend: &str| fixture.export(backend).0.record.image_scale;
    assert_eq!(
        (scale(&fixture, "alicevision"), scale(&fixture, "mve")),
        (0.5, 1.0)
    );
    assert!(fixture.export("alicevision").0.record.commands[0].contains("--downscale 2"));
    assert!(
        !fixture.export("mve").says("image_scale"),
        "nothing is left out"
    );
    fixture.own_size = false;
    assert_eq!(
        (scale(&fixture, "alicevision"), scale(&fixture, "mve")),
        (0.25, 0.25)
    );
}

#[test]
fn an_export_of_nothing_says_so() {
    let mut fixture = Fixture::new(3);
    fixture.clusters.clear();
    for backend in viewrank::backends::BACKENDS {
        assert!(
            fixture.export(backend.name).says("nothing to compute"),
            "{}",
            backend.name
        );
    }
}

/// Groups the names of a table file by index.
pub fn table(text: &str) -> BTreeMap<usize, String> {
    let row = |line: &str| {
        line.split_once('\t')
            .map(|(i, name)| (i.parse().unwrap(), name.to_owned()))
            .unwrap()
    };
    text.lines().map(row).collect()
}
