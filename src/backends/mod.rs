//! The MVS programs that viewrank writes for: one file per backend, everything that is known about it in that file.
//!
//! A backend says which pairs it can match and how its confidence runs (what a plan is made for), and turns a [`Selection`] into
//! the files that make the program compute the chosen view clusters. It returns what is to be written; [`crate::io::output`] writes.

use std::path::PathBuf;

use nalgebra::Vector3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::{
    base::{error::Hint, progress::Watcher},
    config::{Settings, UnknownBackend},
    io::{
        output::{FileSet, OutputError},
        project::{Project, ProjectError},
    },
    model::{
        camera::Camera,
        cluster::{Gate, RankedCluster},
        scene::ViewIndex,
    },
    plan::{Matcher, Plan, PlanError, PlanningNumbers},
};

mod alicevision;
mod clusters;
mod colmap;
mod gipuma;
mod images;
mod metashape;
mod micmac;
mod mve;
mod mvsnet;
mod odm;
mod openmvs;
pub mod place;
mod pmvs;
mod realityscan;
mod selection;
mod sgm;
mod splat;
mod sure;
mod tiles;
mod traps;
mod workspace;

pub(crate) use clusters::recipe;
pub use selection::Selection;
pub use sure::pair_files;
pub use tiles::clusters_by_area;
pub use traps::{Patient, Trap};

/// Every backend, in the order in which `viewrank backends` lists them.
pub fn all() -> &'static [&'static dyn Backend] {
    &[
        &sure::Sure,
        &sgm::Sgm,
        &colmap::Colmap,
        &openmvs::OpenMvs,
        &mvsnet::MVSNET,
        &mvsnet::PATCHMATCHNET,
        &mvsnet::ACMM,
        &pmvs::Pmvs,
        &gipuma::Gipuma,
        &mve::Mve,
        &micmac::MicMac,
        &alicevision::AliceVision,
        &metashape::Metashape,
        &realityscan::RealityScan,
        &odm::Odm,
        &splat::Splat,
        &images::Images,
    ]
}

/// Other names that people type, without case, blanks, `-` and `_`.
const ALIASES: [(&str, &[&str]); 15] = [
    ("sure", &["nframes"]),
    ("openmvs", &["densifypointcloud"]),
    ("mvsnet", &["casmvsnet"]),
    ("patchmatchnet", &["patchmatch"]),
    ("acmm", &["acmh", "acmp", "acmmp"]),
    ("pmvs", &["pmvs2", "cmvs"]),
    ("gipuma", &["fusibile"]),
    ("mve", &["dmrecon"]),
    ("micmac", &["mm3d"]),
    ("alicevision", &["meshroom"]),
    ("metashape", &["photoscan", "agisoft"]),
    ("realityscan", &["realitycapture"]),
    ("odm", &["opendronemap", "webodm"]),
    ("splat", &["3dgs", "gaussiansplatting", "splatting", "splats", "gsplat", "brush", "nerf", "nerfstudio"]),
    ("images", &["image", "list", "imagelist"]),
];

/// A name without case, blanks, `-` and `_`.
fn plain(name: &str) -> String {
    name.chars().filter(|c| !c.is_whitespace() && !"-_".contains(*c)).flat_map(char::to_lowercase).collect()
}

/// The backend of that name, as typed behind `--backend`, or of another name that people use for it.
pub fn by_name(name: &str) -> Result<&'static dyn Backend, UnknownBackend> {
    let wanted = plain(name);
    let meant = ALIASES.iter().find(|(_, others)| others.contains(&&*wanted)).map_or(&*wanted, |(name, _)| name);
    all().iter().copied().find(|b| b.name() == meant).ok_or_else(|| UnknownBackend {
        name: name.trim().into(),
        meant: nearest(name),
        known: all().iter().map(|b| b.name()).collect(),
    })
}

/// The name of the backend that is meant by `name`: what [`Configuration::load`](crate::config::Configuration::load) checks settings with.
pub fn canonical_name(name: &str) -> Result<&'static str, UnknownBackend> {
    by_name(name).map(|backend| backend.name())
}

/// The backends of those names, in their order, each once.
pub fn by_names(names: &[String]) -> Result<Vec<&'static dyn Backend>, UnknownBackend> {
    let mut backends: Vec<&'static dyn Backend> = Vec::new();
    for name in names {
        let backend = by_name(name)?;
        if backends.iter().all(|known| known.name() != backend.name()) {
            backends.push(backend);
        }
    }
    Ok(backends)
}

/// The known name that was probably meant.
fn nearest(name: &str) -> Option<&'static str> {
    let wanted = plain(name);
    let others = ALIASES.iter().flat_map(|(name, others)| others.iter().map(move |other| (*other, *name)));
    let known = all().iter().map(|b| (b.name(), b.name())).chain(others);
    let rated = known.map(|(known, name)| (strsim::jaro_winkler(known, &wanted), name));
    rated.max_by(|a, b| a.0.total_cmp(&b.0)).filter(|(likeness, _)| *likeness > 0.8).map(|(_, name)| name)
}

/// The backend that the project is set up for, else SURE.
pub fn for_project(project: &Project) -> &'static dyn Backend {
    all().iter().copied().find(|b| b.serves(project)).unwrap_or(&sure::Sure)
}

/// The backend that the project is planned for: the first of the settings, else the one that the project is set up for.
pub fn planned_for(project: &Project, settings: &Settings) -> Result<Matcher, UnknownBackend> {
    let backend = match settings.backends.first() {
        Some(name) => by_name(name)?,
        None => for_project(project),
    };
    Ok(Matcher { name: backend.name(), numbers: backend.planning() })
}

/// Plans which views of the project become key views, with which partners, in which order, for the backend that the settings name, else the
/// one that the project is set up for.
pub fn plan(project: &Project, settings: &Settings, watcher: &dyn Watcher) -> Result<Plan, PlanError> {
    Plan::new(project, settings, &planned_for(project, settings)?, watcher)
}

/// How far a backend does what the plan says.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Honours {
    Yes,
    /// Only in part; the backend's `notes` say how.
    Partly,
    No,
}

/// What a backend honours of a plan.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Capabilities {
    /// Exactly the given matching partners.
    pub partners: Honours,
    /// Depth maps for exactly the key views.
    pub key_subset: Honours,
    /// Key views in rank order.
    pub order: Honours,
    /// The step that joins the depth maps, in words.
    pub fusion: &'static str,
    /// What is not honoured, for people.
    pub notes: &'static str,
}

/// The numbers of OpenMVS, for PatchMatch programs that nobody has measured; `support` 2, since they join depth maps that agree.
const PATCH_MATCH: PlanningNumbers = PlanningNumbers {
    refuses: None,
    gate: Gate {
        min_shared_points: 1,
        min_angle_deg: 3.0,
        max_angle_deg: 60.0,
        max_scale_octaves: 1.68,
        epipole_inside: true,
    },
    confidence: openmvs::CONFIDENCE,
    support: 2,
    measured: "no: openmvs's",
    source: "not measured: the numbers of OpenMVS, another PatchMatch (method 7.1, 7.2); support 2: depth maps are joined where they agree",
};

/// An MVS program.
pub trait Backend: Sync {
    /// As typed behind `--backend`.
    fn name(&self) -> &'static str;

    fn capabilities(&self) -> Capabilities;

    fn planning(&self) -> PlanningNumbers;

    /// Is the project set up for this backend, so that `plan` writes its files unasked?
    fn serves(&self, project: &Project) -> bool {
        let _ = project;
        false
    }

    /// Options of `viewrank export` that it heeds beside `--out`, as they are typed.
    fn options(&self) -> &'static [&'static str] {
        &[]
    }

    /// How tasks of a queue compute the clusters of an export with the default options; `None`: only its whole run can.
    fn tasks(&self, selection: &Selection, export: &Export) -> Option<TaskRunner> {
        let _ = (selection, export);
        None
    }

    /// What the key views are for where they get no depth maps, as a verb: "Train on" (6 of 28 images).
    fn use_of_views(&self) -> Option<&'static str> {
        None
    }

    /// Does it take cameras with lens distortion?
    fn takes_distorted(&self) -> bool {
        false
    }

    /// What of this project would go wrong with it whatever is planned, beside the distortion of the cameras.
    fn traps(&self, patient: &Patient) -> Vec<Trap> {
        let _ = patient;
        Vec::new()
    }

    /// What is to be written for the selection; writes nothing.
    fn export(&self, selection: &Selection, options: &ExportOptions) -> Result<Export, BackendError>;
}

/// Which views COLMAP makes depth maps for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum References {
    /// The key views.
    #[serde(rename = "keys")]
    Keys,
    /// The key views and, photometric only, their partners: what geometric consistency needs.
    #[serde(rename = "keys+partners")]
    KeysAndPartners,
    /// Every view of the model, key views first.
    #[serde(rename = "all")]
    All,
}

/// What a user can choose about an export.
#[derive(Clone, Debug, Default)]
pub struct ExportOptions {
    /// Where the files go; `None`: the backend's own place in the project.
    pub out: Option<PathBuf>,
    /// COLMAP; unset: `keys+partners` with geometric consistency, else `keys`.
    pub refs: Option<References>,
    /// COLMAP: depth maps checked against those of their partners. Unset: off, unless `refs` asks for partners' maps.
    pub geometric: Option<bool>,
    /// OpenMVS: a list of neighbours for this scene instead of a scene per cluster.
    pub scene: Option<PathBuf>,
    /// OpenMVS with `scene`: a copy of the scene, scaled so that OpenMVS's depth range fits.
    pub scale: bool,
}

impl ExportOptions {
    /// The files of a backend whose place is a folder of its own.
    fn file_set(&self, backend: &dyn Backend, selection: &Selection) -> FileSet {
        let own = || selection.project.output_folder().join(backend.name());
        FileSet::new(self.out.clone().unwrap_or_else(own), backend.name())
    }
}

/// What is to be written for a backend, and what is to be known about it.
#[derive(Clone, Debug)]
pub struct Export {
    pub files: FileSet,
    /// Also in `files`, as `export.json`.
    pub record: ExportRecord,
}

/// What an export promises and what it doesn't: written beside the files and into the manifest.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ExportRecord {
    /// As typed behind `--backend`.
    pub backend: String,
    /// Programs and versions that the files were made for.
    pub made_for: String,
    /// Which of several ways was taken.
    pub way: String,
    /// Script among the files that runs all of `commands`.
    pub runner: Option<String>,
    /// Commands, in order, to be typed in the folder of the files.
    pub commands: Vec<String>,
    /// What of the plan the backend will not do.
    pub not_honoured: Vec<String>,
    /// What should be known before running it.
    pub warnings: Vec<String>,
    /// Depth maps of key views that will be computed.
    pub key_maps: usize,
    /// Depth maps of other views that the way needs.
    pub other_maps: usize,
    /// Factor from scene units to the units of the files.
    pub scale: f64,
    /// Added to COLMAP's pixel coordinates (centre of the first pixel 0.5, 0.5) in the files.
    pub pixel_shift: f64,
    /// World coordinates of the origin of the files, scene units (coordinates in f32 lose the decimals of map coordinates).
    pub origin: [f64; 3],
    /// Options of the step that joins the depth maps, and why.
    pub fusion: String,
    /// The clusters in rank order, as the backend knows them.
    pub clusters: Vec<ExportedCluster>,
}

/// A view cluster in an export.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ExportedCluster {
    /// From 1.
    pub rank: usize,
    pub key: ExportedView,
    /// Best first.
    pub partners: Vec<ExportedView>,
}

/// A view as the model and as the backend know it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ExportedView {
    /// As in the model, relative to the image folder.
    pub name: String,
    /// Id of the image in the model.
    pub image_id: u32,
    /// Index or name in the backend's files.
    pub target: String,
}

impl ExportRecord {
    /// A record for the selection, views known to the backend as `target` says.
    fn new(backend: &dyn Backend, selection: &Selection, target: impl Fn(ViewIndex) -> String) -> Self {
        let view = |v: ViewIndex| ExportedView {
            name: selection.scene.name(v).into(),
            image_id: selection.scene.view(v).image_id,
            target: target(v),
        };
        let cluster = |(i, c): (usize, &RankedCluster)| ExportedCluster {
            rank: i + 1,
            key: view(c.key),
            partners: c.partners.iter().map(|&p| view(p)).collect(),
        };
        let faults = selection.image_faults.among(&selection.views());
        Self {
            backend: backend.name().into(),
            key_maps: selection.clusters.len(),
            scale: 1.0,
            clusters: selection.clusters.iter().enumerate().map(cluster).collect(),
            warnings: nothing_chosen(selection)
                .into_iter()
                .chain(faults.warnings(selection.project, selection.scene))
                .chain(without_images(selection, &faults.missing))
                .chain(other_kind(backend, selection))
                .collect(),
            ..Self::default()
        }
    }

    /// Notes that the files count from another origin than the world's.
    fn moved(&mut self, origin: Vector3<f64>) {
        self.origin = origin.into();
        if origin != Vector3::zeros() {
            let [x, y, z] = self.origin;
            self.warnings.push(format!(
                "the program counts in 32 bits, too coarse for these coordinates: those in its files are less by {x} {y} {z}; add that to what comes out"
            ));
        }
    }

    /// Notes the images that are not matched at the planned size; `scale` is what the files ask for, for each camera.
    fn note_scale(&mut self, selection: &Selection, scale: impl Fn(&Camera) -> f64) {
        let wanted = selection.image_scale;
        let scale_of = |view: ViewIndex| scale(selection.scene.camera_of(view));
        let views = selection.views();
        let other = |view: &&ViewIndex| (scale_of(**view) / wanted).log2().abs() > 0.01;
        let others: Vec<ViewIndex> = views.iter().filter(other).copied().collect();
        let Some(&first) = others.first() else { return };
        self.not_honoured.push(format!(
            "image_scale {wanted}: {} of {} images are matched at {:.3} of their size, as {}",
            others.len(),
            views.len(),
            scale_of(first),
            selection.scene.name(first)
        ));
    }

    /// The same where the program's own options choose the size.
    fn note_own_scale(&mut self, selection: &Selection) {
        if selection.image_scale != 1.0 {
            let scale = selection.image_scale;
            self.not_honoured.push(format!("image_scale {scale}: the program's own options choose the size"));
        }
    }

    /// The contents of `export.json`.
    fn to_json(&self) -> String {
        serde_json::to_string_pretty(self).expect("a record has string keys and finite numbers") + "\n"
    }
}

/// A warning of the view clusters that cannot be computed as planned; `missing` ascends.
fn without_images(selection: &Selection, missing: &[ViewIndex]) -> Option<String> {
    let is_missing = |view: &ViewIndex| missing.binary_search(view).is_ok();
    let lacks = |c: &RankedCluster| std::iter::once(&c.key).chain(&c.partners).any(is_missing);
    let ranks = (1..).zip(selection.clusters).filter(|(_, c)| lacks(c)).map(|(rank, _): (usize, _)| rank.to_string());
    let ranks: Vec<String> = ranks.collect();
    let some = ranks.iter().take(NAMED_RANKS).cloned().collect::<Vec<_>>().join(", ");
    let more = if ranks.len() > NAMED_RANKS { ", ..." } else { "" };
    (!ranks.is_empty())
        .then(|| format!("view clusters that lack an image, by rank: {some}{more}; they cannot be computed as planned"))
}

/// Ranks that a warning names.
const NAMED_RANKS: usize = 10;

/// A warning where there is no view cluster.
fn nothing_chosen(selection: &Selection) -> Option<String> {
    let why = || format!("{}/manifest.json says why", selection.project.output_folder().display());
    selection.clusters.is_empty().then(|| format!("no view cluster is chosen, there is nothing to compute: {}", why()))
}

/// A warning where the plan was made for a backend that matches otherwise.
fn other_kind(backend: &dyn Backend, selection: &Selection) -> Option<String> {
    let planned_for = by_name(selection.planned_for).ok()?;
    let (is, was) = (backend.planning(), planned_for.planning());
    let differs = is.gate != was.gate || is.confidence != was.confidence || is.support != was.support;
    let why = match backend.use_of_views() {
        Some(_) => "whose depth maps need other support",
        None => "which matches other pairs or needs other support",
    };
    differs.then(|| {
        format!(
            "the plan was made for {}, {why}; one made for this program: viewrank plan {} --backend {}",
            planned_for.name(),
            selection.project.as_argument(),
            backend.name()
        )
    })
}

/// The scale of images whose long side is capped for all cameras alike.
fn capped_scale(cap: u32) -> impl Fn(&Camera) -> f64 {
    move |camera| (f64::from(cap) / f64::from(camera.width.max(camera.height))).min(1.0)
}

/// How single tasks of a queue compute the clusters of an export: what `viewrank dispatch` needs to know of a backend.
///
/// `compute` and `fuse` are lines of sh that run in the folder of the export, where `$project`, `$rank` (from 1), `$threads`,
/// `$program` and `$python` are set.
#[derive(Clone, Debug)]
pub struct TaskRunner {
    /// The program that does the work, as it is found on the PATH.
    pub program: &'static str,
    /// Variable of the environment that says where else it is.
    pub variable: &'static str,
    /// Computes one cluster; fails unless a whole depth map came out. Tasks run it side by side.
    pub compute: String,
    /// Joins the depth maps that are there.
    pub fuse: String,
    /// Depth map of each cluster, in rank order; `None` where none can be made.
    pub maps: Vec<Option<PathBuf>>,
}

/// Why a backend's files cannot be made.
#[derive(Debug, thiserror::Error)]
pub enum BackendError {
    #[error(transparent)]
    Unknown(#[from] UnknownBackend),
    #[error("{backend} cannot take the image name \"{name}\": {why}")]
    Name { backend: &'static str, name: String, why: String },
    #[error("{option} is none of the options of {backends}")]
    Option { option: &'static str, backends: String },
    #[error("{backend} needs {what}")]
    Needs { backend: &'static str, what: String, hint: String },
    #[error("the export would write {}, which is the project's own", _0.display())]
    OwnFile(PathBuf),
    #[error("{} belongs to another model, with which that of the export would be mixed up", _0.display())]
    OtherModel(PathBuf),
    #[error("{} holds the export for {backend}", folder.display())]
    OtherExport { folder: PathBuf, backend: String },
    #[error(transparent)]
    Place(#[from] OutputError),
    #[error(transparent)]
    Model(Box<ProjectError>),
}

impl From<ProjectError> for BackendError {
    fn from(error: ProjectError) -> Self {
        Self::Model(Box::new(error))
    }
}

impl Hint for BackendError {
    fn hint(&self) -> Option<String> {
        Some(match self {
            Self::Unknown(error) => return error.hint(),
            Self::Name { .. } => "rename the image file and its entry in the model, then plan again".into(),
            Self::Option { option, .. } => {
                let heed = all().iter().filter(|b| b.options().contains(option)).map(|b| b.name());
                format!("leave it out; it is for {}", heed.collect::<Vec<_>>().join(", "))
            }
            Self::Needs { hint, .. } => hint.clone(),
            Self::OwnFile(_) => "write to another folder with --out".into(),
            Self::OtherModel(_) => "write to another folder with --out, or move that model away".into(),
            Self::OtherExport { .. } => "write to another folder with --out, or remove that one first".into(),
            Self::Place(error) => return error.hint(),
            Self::Model(error) => return error.hint(),
        })
    }

    fn is_usage(&self) -> bool {
        matches!(self, Self::Unknown(_) | Self::Option { .. })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_unique_and_found() {
        for backend in all() {
            assert_eq!(by_name(backend.name()).unwrap().name(), backend.name());
            assert_eq!(all().iter().filter(|b| b.name() == backend.name()).count(), 1);
        }
        assert!(by_name("nothing").is_err_and(|e| e.hint().unwrap().contains("sure")));
    }

    #[test]
    fn names_are_understood_as_people_type_them() {
        for (typed, meant) in [
            ("COLMAP", "colmap"),
            (" OpenMVS ", "openmvs"),
            ("Meshroom", "alicevision"),
            ("3DGS", "splat"),
            ("Reality Capture", "realityscan"),
        ] {
            assert_eq!(by_name(typed).unwrap().name(), meant);
        }
        for (alias, others) in ALIASES.iter().flat_map(|(name, others)| others.iter().map(move |o| (o, *name))) {
            assert_eq!(by_name(alias).unwrap().name(), others);
        }
        let once = by_names(&["openmvs".into(), "COLMAP".into(), "OpenMVS".into()]).unwrap();
        assert_eq!(once.iter().map(|b| b.name()).collect::<Vec<_>>(), ["openmvs", "colmap"]);
        let hint = |name: &str| by_name(name).err().unwrap().hint().unwrap();
        assert!(hint("colmpa").starts_with("did you mean colmap? take one of sure, "));
        assert!(hint("xyz").starts_with("take one of sure, "));
    }
}
