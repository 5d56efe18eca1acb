//! `manifest.json`: the ranking and its context (method 6), for other programs.
//!
//! The structs define the format; the JSON Schema under `schema/` is generated from them and their
//! comments. Same input, same bytes: nothing depends on the clock, the machine or the number of
//! threads.

mod check;
mod fingerprint;
mod region;
mod written;

use schemars::{JsonSchema, Schema, schema_for};
use serde::{Deserialize, Serialize};

pub use fingerprint::{FingerprintError, fingerprint};
pub use region::RegionSummary;
pub(crate) use written::{FILE, RecordedPlan, read_own};
pub use written::{
    PlannedMaps, WrittenPlan, WrittenPlanError, open_planned_workspace, planned_backend,
    planned_backends, planned_ground, planned_maps, planned_model, planned_options,
    planned_test_every, planned_workspace, validate,
};

use crate::{
    backends::ExportRecord,
    base::{paths::absolute, printable::to_json},
    config::{Settings, TypedSetting},
    io::project::{ImageFaults, Project},
    method::surface::SurfaceStats,
    model::{
        cluster::{MapScale, RankedCluster},
        reason::Reason,
        scene::{Units, ViewIndex},
        surface::SurfaceKind,
    },
    plan::{Cut, Forecast, OutdatedMap, Plan, ViewStatus},
    show::cell::cell,
};

/// Version of the format; readers accept only manifests with this number, and check it before
/// anything else. Raised when an older reader would misunderstand a manifest or refuse it for
/// another reason.
pub(crate) const VERSION: u32 = 2;

/// A ranking of view clusters: which key views get depth maps, with which matching partners, in
/// which order.
#[derive(Clone, Debug, Serialize, JsonSchema)]
pub struct Manifest {
    /// Version of this format.
    #[schemars(extend("const" = VERSION))]
    pub version: u32,
    /// Program and version that wrote it.
    pub tool: String,
    pub input: Input,
    /// "metric": a scene unit is a metre. "relative": its length is unknown.
    pub units: Units,
    /// Backend that the plan is for. Pairs that it cannot match are not candidates; the values of
    /// its confidence and support are in `settings`.
    pub backend: String,
    /// All settings in force, nested as in viewrank.toml, with the values that the data or the
    /// backend decided.
    pub settings: Settings,
    /// Those of the settings that were typed as options; `viewrank run` goes on with them.
    pub typed: Vec<TypedSetting>,
    /// True if `settings.image_scale` was not set: it is the backend's default.
    pub own_size: bool,
    pub surface: SurfaceSummary,
    /// Region of interest; null if the plan is for the whole surface.
    pub region: Option<RegionSummary>,
    /// The whole ranking, best first; the clusters up to `cut` are to be computed.
    pub clusters: Vec<ClusterEntry>,
    /// Position of the cut in the ranking, and its results.
    pub cut: Cut,
    /// All registered views, by name.
    pub views: Vec<ViewEntry>,
    /// Images without a pose, by name.
    pub unregistered: Vec<String>,
    /// Finished depth maps that no longer fit the model, by key view; they are ignored and must be
    /// recomputed.
    pub outdated: Vec<OutdatedMap>,
    pub forecast: Forecast,
    /// Files written for each backend, and parts of the plan that it does not honour.
    pub exports: Vec<ExportRecord>,
    /// Warnings to read before relying on the plan, in sentences.
    pub warnings: Vec<String>,
}

/// Joins the warnings of a plan, `further` ones, and those of its exports, without what they say of
/// image files: the plan says it of all views. Parts of the plan that a backend does not honour are
/// no warnings, since users cannot change them: they are in `viewrank backends` and the records of
/// the exports.
pub fn warnings_with(
    of_plan: &[String],
    exports: &[ExportRecord],
    further: &[String],
) -> Vec<String> {
    let mut warnings: Vec<String> = of_plan.iter().chain(further).cloned().collect();
    for ExportRecord {
        backend,
        warnings: own,
        ..
    } in exports
    {
        let own = own
            .iter()
            .filter(|warning| !of_plan.contains(warning) && !ImageFaults::is_warning(warning));
        warnings.extend(own.map(|warning| format!("{backend}: {warning}")));
    }
    warnings
}

/// Input of the plan.
#[derive(Clone, Debug, Serialize, JsonSchema)]
pub struct Input {
    /// Format of the sparse model.
    pub format: String,
    /// Folder of the model, relative to the project folder; "." is the folder itself.
    pub model: String,
    /// BLAKE3 hash of the model's files, the mesh and the region, the names and sizes of the
    /// registered images and, where the confidence reads them, both ends of images and masks; equal
    /// for equal input.
    pub fingerprint: String,
    /// Registered images.
    pub views: usize,
    /// Sparse points.
    pub points: usize,
    /// Observations of sparse points.
    pub observations: usize,
}

/// Surface of the plan.
#[derive(Clone, Debug, Serialize, JsonSchema)]
pub struct SurfaceSummary {
    /// "3d": carved from the tetrahedra of the points. "terrain": 2.5D. "mesh": from a file.
    pub kind: SurfaceKind,
    /// Vertices of the triangles.
    pub vertices: usize,
    /// Triangles that at least one view sees.
    pub triangles: usize,
    /// Square scene units.
    pub area: f64,
    /// Triangles that no single cluster fulfils to a tenth (best f below 0.1); with a region, those
    /// inside.
    pub unfulfilled: usize,
    /// Statistics of its reconstruction.
    pub made: SurfaceStats,
}

/// A view cluster with its rank.
#[derive(Clone, Debug, Serialize, JsonSchema)]
pub struct ClusterEntry {
    /// Rank, from 1.
    pub rank: usize,
    /// Name of the key view, which gets a depth map.
    pub key: String,
    /// Names of the views that the key view is matched against, best first.
    pub partners: Vec<String>,
    /// Those of them that are beyond the gate (`settings.partners.gate`), chosen because there are
    /// no better ones; matching them may fail.
    pub beyond_gate: Vec<String>,
    /// Size at which the key view is matched, over `settings.image_scale`: 1 or 0.5.
    pub scale: MapScale,
    /// Work of the clusters up to this one, over that of all clusters at full size; 0 for a program
    /// that makes no depth maps.
    pub work: f64,
    /// Fulfilment that it adds to the clusters before it.
    pub gain: f64,
    /// Fulfilment of the clusters up to this one, 0 to 1: f_o or, for a program that uses the
    /// images themselves, the part of all photographs that they draw (method 5.10).
    pub fulfilment: f64,
    /// Weight that fusion keeps of the clusters up to this one, over that of all clusters, 0 to 1.
    /// For a program that uses the images themselves: their fulfilment over that of all.
    pub share: f64,
    /// The same by area: what the fused cloud of these clusters covers of the fused cloud of all; 0
    /// for a program that makes no depth maps.
    #[serde(default)]
    pub area: f64,
    /// True if its depth map is finished; gain and fulfilment are then measured. Finished clusters
    /// come first.
    pub finished: bool,
}

/// Status of a registered view.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
pub struct ViewEntry {
    /// Name in the model, relative to the image folder.
    pub name: String,
    /// Key view, partner or unused.
    pub status: ViewStatus,
    /// Reason why it is not a key view, or has fewer than k partners; null without one.
    pub reason: Option<Reason>,
}

impl Manifest {
    /// `exports`: records of the exports written together with the plan.
    pub fn new(
        plan: &Plan,
        project: &Project,
        exports: Vec<ExportRecord>,
    ) -> Result<Self, FingerprintError> {
        let (typed, home) = (plan.stages.settings.typed.iter(), absolute(&project.home));
        Ok(Self {
            version: VERSION,
            tool: concat!("viewrank ", env!("CARGO_PKG_VERSION")).into(),
            input: Input::new(plan, project)?,
            units: plan.stages.settings.units.unwrap_or(Units::Relative),
            backend: plan.stages.backend.into(),
            settings: plan.stages.settings.for_plan(),
            typed: typed.map(|typed| typed.written_in(&home)).collect(),
            own_size: plan.stages.own_size,
            surface: SurfaceSummary::new(plan),
            region: RegionSummary::from_plan(plan),
            clusters: clusters(plan),
            cut: plan.decision.cut,
            views: plan
                .stages
                .scene
                .view_indices()
                .map(|view| ViewEntry::new(plan, view))
                .collect(),
            unregistered: plan.stages.scene.unregistered.clone(),
            outdated: plan.finished.outdated.clone(),
            forecast: plan.decision.forecast,
            exports,
            warnings: plan.warnings.clone(),
        })
    }

    /// Returns the contents of `manifest.json`.
    pub fn to_json(&self) -> String {
        to_json(self)
    }

    /// Returns the contents of `manifest.csv`: a line per cluster, for spreadsheets, with names as
    /// [cells](cell).
    pub fn to_csv(&self) -> String {
        let most = self
            .clusters
            .iter()
            .map(|cluster| cluster.partners.len())
            .max()
            .unwrap_or(0);
        let partners = (1..=most).map(|n| format!("partner_{n}"));
        let fixed = [
            "rank",
            "chosen",
            "key",
            "scale",
            "work",
            "gain",
            "fulfilment",
            "share",
        ]
        .map(String::from);
        let mut lines = csv::WriterBuilder::new().from_writer(Vec::new());
        let mut write = |line: Vec<String>| {
            lines
                .write_record(line)
                .expect("lines of equal length, to memory")
        };
        write(fixed.into_iter().chain(partners).collect());
        for cluster in &self.clusters {
            let chosen = if cluster.rank <= self.cut.clusters {
                "yes"
            } else {
                "no"
            };
            let scale = cluster.scale.factor();
            let numbers = [
                scale,
                cluster.work,
                cluster.gain,
                cluster.fulfilment,
                cluster.share,
            ]
            .map(|number| number.to_string());
            let start = [cluster.rank.to_string(), chosen.into(), cell(&cluster.key)]
                .into_iter()
                .chain(numbers);
            let empty = std::iter::repeat_n(String::new(), most - cluster.partners.len());
            write(
                start
                    .chain(cluster.partners.iter().map(|partner| cell(partner)))
                    .chain(empty)
                    .collect(),
            );
        }
        String::from_utf8(lines.into_inner().expect("written to memory"))
            .expect("written from texts")
    }

    /// Returns the JSON Schema of the format.
    pub fn schema() -> Schema {
        schema_for!(Self)
    }
}

impl Input {
    fn new(plan: &Plan, project: &Project) -> Result<Self, FingerprintError> {
        Ok(Self {
            format: project.model.format.name().into(),
            model: project.model_path(),
            fingerprint: fingerprint(project, &plan.stages.scene, &plan.stages.settings)?,
            views: plan.stages.scene.views.len(),
            points: plan.stages.scene.points.len(),
            observations: plan.stages.scene.observations(),
        })
    }
}

impl SurfaceSummary {
    fn new(plan: &Plan) -> Self {
        let surface = &plan.stages.surface;
        Self {
            kind: surface.kind,
            vertices: surface.vertices.len(),
            triangles: surface.triangles.len(),
            area: (0..surface.triangles.len() as u32)
                .map(|t| surface.area(t))
                .sum(),
            unfulfilled: plan.unfulfilled().count(),
            made: plan.stages.surface_stats.clone(),
        }
    }
}

impl ViewEntry {
    fn new(plan: &Plan, view: ViewIndex) -> Self {
        let (status, reason) = plan.decision.views[view.index()];
        Self {
            name: plan.stages.scene.name(view).into(),
            status,
            reason,
        }
    }
}

fn clusters(plan: &Plan) -> Vec<ClusterEntry> {
    let name = |view: ViewIndex| plan.stages.scene.name(view).to_owned();
    let ranked = plan.ranked().enumerate();
    let beyond = |of: &RankedCluster| -> Vec<String> {
        let beyond = plan.stages.candidates.beyond_gate(of.key);
        of.partners
            .iter()
            .filter(|partner| beyond.contains(partner))
            .map(|&partner| name(partner))
            .collect()
    };
    let share_of = plan.stages.shares_of_work();
    let mut work = 0.0;
    // Adds up, so the entries are made in the order of the ranking.
    let mut work_to = |i: usize| {
        if plan.stages.makes_maps {
            let ranking = &plan.decision.ranking;
            work += share_of(ranking.order[i], ranking.scales[i]);
        }
        work
    };
    let entry = |(i, cluster): (usize, RankedCluster)| ClusterEntry {
        rank: i + 1,
        scale: cluster.scale,
        work: work_to(i),
        beyond_gate: beyond(&cluster),
        key: name(cluster.key),
        partners: cluster.partners.into_iter().map(name).collect(),
        gain: plan.decision.ranking.gains[i],
        fulfilment: plan.decision.ranking.fulfilment[i],
        share: cluster.share,
        area: plan.decision.area_shares[i],
        finished: i < plan.decision.finished,
    };
    ranked.map(entry).collect()
}
