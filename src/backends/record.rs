//! `export.json`: contents, limits and warnings of an export.

use nalgebra::Vector3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{Backend, Selection, by_name};
use crate::{
    base::printable::to_json,
    io::{output::FileSet, pictures::PictureFolders},
    model::{
        camera::Camera,
        cluster::{MapScale, RankedCluster},
        scene::ViewIndex,
    },
};

/// The files for a backend with their record.
#[derive(Clone, Debug)]
pub struct Export {
    pub files: FileSet,
    /// Also in `files`, as `export.json`.
    pub record: ExportRecord,
}

impl Export {
    /// Completes the files with their record.
    pub(super) fn new(mut files: FileSet, record: ExportRecord) -> Self {
        files.add_text("export.json", record.to_json());
        Self { files, record }
    }
}

/// Commands, limits and clusters of an export; written next to the files and into the manifest.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ExportRecord {
    /// Value of `--backend`.
    pub backend: String,
    /// Programs and versions that the files were made for.
    pub made_for: String,
    /// Variant of the export, if the backend has several.
    pub way: String,
    /// Script in the export that runs all `commands`.
    pub runner: Option<String>,
    /// Commands to run in the folder of the files, in order.
    pub commands: Vec<String>,
    /// Parts of the plan that the backend does not honour.
    pub not_honoured: Vec<String>,
    /// Warnings to read before running the program.
    pub warnings: Vec<String>,
    /// Depth maps of key views that will be computed.
    pub key_maps: usize,
    /// Depth maps of other views that this variant needs.
    pub other_maps: usize,
    /// Size of the matched images over the model's, as planned; by default the program's own.
    #[serde(default)]
    pub image_scale: f64,
    /// Factor from scene units to the units of the files.
    pub scale: f64,
    /// Added to COLMAP's pixel coordinates (centre of the first pixel 0.5, 0.5) in the files.
    pub pixel_shift: f64,
    /// World coordinates of the origin of the files, scene units (f32 loses the decimals of map
    /// coordinates).
    pub origin: [f64; 3],
    /// Options of the fusion, with reasons.
    pub fusion: String,
    /// The clusters in rank order, with the backend's names of views.
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
    /// Size at which it is matched, over `image_scale`.
    #[serde(default)]
    pub scale: MapScale,
}

/// A view under its names in the model and in the backend's files.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ExportedView {
    /// As in the model, relative to the image folder.
    pub name: String,
    /// Id of the image in the model.
    pub image_id: u32,
    /// Index or name in the backend's files.
    pub target: String,
}

/// Returns a warning if key views are planned at half the size, for a program that matches all at
/// one size.
pub(super) fn at_full_size(selection: &Selection) -> Option<String> {
    let half = selection
        .clusters
        .iter()
        .filter(|cluster| cluster.scale == MapScale::Half)
        .count();
    (half > 0).then(|| {
        format!("{half} key views that are planned at half the size are matched at full size")
    })
}

impl ExportRecord {
    /// Starts a record for the selection; `target` names a view in the backend's files.
    pub(super) fn new(
        backend: &Backend,
        selection: &Selection,
        target: impl Fn(ViewIndex) -> String,
    ) -> Self {
        let view = |v: ViewIndex| ExportedView {
            name: selection.scene.name(v).into(),
            image_id: selection.scene.view(v).image_id,
            target: target(v),
        };
        let cluster = |(i, c): (usize, &RankedCluster)| ExportedCluster {
            rank: i + 1,
            key: view(c.key),
            partners: c.partners.iter().map(|&p| view(p)).collect(),
            scale: if backend.mixes_sizes {
                c.scale
            } else {
                MapScale::Full
            },
        };
        let faults = selection.image_faults.among(&selection.views());
        Self {
            backend: backend.name.into(),
            key_maps: selection.clusters.len(),
            image_scale: selection.image_scale,
            scale: 1.0,
            clusters: selection.clusters.iter().enumerate().map(cluster).collect(),
            warnings: nothing_chosen(selection)
                .into_iter()
                .chain(faults.warnings(selection.project, selection.scene))
                .chain(without_images(selection, &faults.missing))
                .chain(masks(selection).filter(|_| !backend.takes_masks))
                .chain(other_kind(backend, selection))
                .chain(at_full_size(selection).filter(|_| !backend.mixes_sizes))
                .collect(),
            ..Self::default()
        }
    }

    /// Records the origin of the files, with a warning if it is not the world's.
    pub(super) fn moved(&mut self, origin: Vector3<f64>) {
        self.origin = origin.into();
        if origin != Vector3::zeros() {
            let [x, y, z] = self.origin;
            self.warnings.push(format!(
                "the program counts in 32 bits, too coarse for these coordinates: those in its files are less by {x} {y} {z}; add that to what comes out"
            ));
        }
    }

    /// Records the images that are not matched at the planned size; `scale` is the size over the
    /// image's that the files ask for.
    pub(super) fn note_scale(&mut self, selection: &Selection, scale: impl Fn(&Camera) -> f64) {
        let wanted = selection.image_scale;
        let scale_of = |view: ViewIndex| scale(selection.scene.camera_of(view));
        let views = selection.views();
        // Sizes are whole pixels, so that a small difference is rounding.
        let other = |view: &&ViewIndex| (scale_of(**view) / wanted).log2().abs() > 0.01;
        let others: Vec<ViewIndex> = views.iter().filter(other).copied().collect();
        let Some(&first) = others.first() else { return };
        self.warnings.push(format!(
            "image_scale {wanted}: {} of {} images are matched at {:.3} of their size, as {}",
            others.len(),
            views.len(),
            scale_of(first),
            selection.scene.name(first)
        ));
    }

    /// Warns that the program's own options determine the size if the user has set one.
    pub(super) fn note_own_scale(&mut self, selection: &Selection) {
        if !selection.own_size && selection.image_scale != 1.0 {
            let scale = selection.image_scale;
            self.warnings.push(format!(
                "image_scale {scale}: the program's own options choose the size"
            ));
        }
    }

    /// Returns the contents of `export.json`.
    pub(super) fn to_json(&self) -> String {
        to_json(self)
    }
}

/// Warns of view clusters that cannot be computed as planned because images are missing; `missing`
/// is ascending.
fn without_images(selection: &Selection, missing: &[ViewIndex]) -> Option<String> {
    let lacks = |c: &RankedCluster| c.views().any(|view| missing.binary_search(&view).is_ok());
    let ranks = (1..)
        .zip(selection.clusters)
        .filter(|(_, c)| lacks(c))
        .map(|(rank, _): (usize, _)| rank.to_string());
    let ranks: Vec<String> = ranks.collect();
    let some = ranks
        .iter()
        .take(NAMED_RANKS)
        .cloned()
        .collect::<Vec<_>>()
        .join(", ");
    let more = if ranks.len() > NAMED_RANKS {
        ", ..."
    } else {
        ""
    };
    (!ranks.is_empty())
        .then(|| format!("view clusters that lack an image, by rank: {some}{more}; they cannot be computed as planned"))
}

/// Warns that masks are left to the user, if one of the views has a mask.
fn masks(selection: &Selection) -> Option<String> {
    let pictures = PictureFolders::new(selection.project);
    let folder = pictures.masks_of(
        selection
            .views()
            .iter()
            .map(|view| selection.scene.name(*view)),
    )?;
    Some(format!(
        "masks (as in {}) are not passed on: give them to the program yourself, if it takes any",
        folder.display()
    ))
}

/// Largest number of ranks listed in a warning.
const NAMED_RANKS: usize = 10;

/// Returns a warning if the selection has no view cluster.
fn nothing_chosen(selection: &Selection) -> Option<String> {
    let why = || {
        format!(
            "{}/manifest.json says why",
            selection.project.output_folder().display()
        )
    };
    selection.clusters.is_empty().then(|| {
        format!(
            "no view cluster is chosen, there is nothing to compute: {}",
            why()
        )
    })
}

/// Returns a warning if the plan was made for a backend that matches differently.
fn other_kind(backend: &Backend, selection: &Selection) -> Option<String> {
    let planned_for = by_name(selection.planned_for).ok()?;
    let (is, was) = (&backend.planning, &planned_for.planning);
    let takes_images = |backend: &Backend| !backend.makes_maps();
    let differs = is.gate != was.gate
        || is.confidence != was.confidence
        || is.support != was.support
        || takes_images(backend) != takes_images(planned_for);
    let why = if takes_images(backend) {
        "which makes depth maps"
    } else if takes_images(planned_for) {
        "which uses the images themselves"
    } else {
        "which matches other pairs or needs other support"
    };
    differs.then(|| {
        format!(
            "the plan was made for {}, {why}; one made for this program: viewrank plan {} --backend {}",
            planned_for.name,
            selection.project.as_argument(),
            backend.name
        )
    })
}

/// Returns the scale of images whose long side is limited to the same number of pixels for all
/// cameras.
pub(super) fn capped_scale(cap: u32) -> impl Fn(&Camera) -> f64 {
    move |camera| (f64::from(cap) / f64::from(camera.width.max(camera.height))).min(1.0)
}
