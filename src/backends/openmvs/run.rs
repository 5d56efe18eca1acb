//! The tasks of an export: `run.json`, and how DensifyPointCloud computes and fuses what it lists.
//!
//! A map is made in `unfinished/`, and moved to its place if it is what the plan asked for:
//! DensifyPointCloud exits with 0 whatever it did. The cloud is made there too, from links to the
//! maps that are finished.

use std::{
    collections::{BTreeMap, BTreeSet},
    ffi::OsString,
    path::{Path, PathBuf},
};

use serde::{Deserialize, Serialize};

use super::{
    MAPS_PER_POINT, fusion, resolution,
    scene::{Builder, DepthRange},
};
use crate::{
    backends::{Call, ExportOptions, Product, Selection, clusters::task_marker},
    base::platform,
    io::{
        depthmaps::openmvs::WholeMap,
        input::{self, FileKind},
        output,
    },
    model::{
        cluster::{MapScale, RankedCluster},
        scene::ViewIndex,
    },
};

/// Share of pixels with a depth below which a map counts as empty.
const LEAST_FILLED: f64 = 0.01;
/// What [`Row::depths`] may differ by: OpenMVS searches 0.9 and 1.1 times the range.
const RANGE: [f64; 2] = [0.8, 1.25];

/// Options of every run of DensifyPointCloud: all views, none reduced by a level.
const OPTIONS: [&str; 10] = [
    "--verbosity",
    "1",
    "--resolution-level",
    "0",
    "--min-resolution",
    "16",
    "--number-views",
    "0",
    // The partners have no maps.
    "--geometric-iters",
    "0",
];
/// Filter 3: speckles and gaps, without the one that needs the partners' maps.
const OF_MAPS: [&str; 4] = ["--fusion-mode", "1", "--postprocess-dmaps", "3"];
const OF_THE_CLOUD: [&str; 2] = ["--postprocess-dmaps", "0"];
/// Options of newer versions, by which nothing is cut off or made up around the sparse points.
const WHERE_KNOWN: [[&str; 2]; 3] = [
    ["--estimate-roi", "0"],
    ["--crop-to-roi", "0"],
    ["--tower-mode", "0"],
];
/// Filter 1 keeps what two maps agree on, filter 0 all that a single one has; filter 2, the default
/// since v2.4.0, joins five pixels or none.
const FILTER: &str = "--fusion-filter";

/// `options.cfg`: OpenMVS would read one that somebody left in the folder of the map.
pub const NO_OPTIONS: &str = "# Options of DensifyPointCloud come from its command line alone.\n";

/// Content of `run.json`.
#[derive(Serialize, Deserialize)]
pub struct Run {
    pub clusters: Vec<Row>,
    /// For each image of `fuse.mvs`, the indices of the key views that overlap it, best first, as
    /// many as a fusion of the first maps may need; empty if it is not a key view.
    pub overlaps: Vec<Vec<usize>>,
    /// Folder of the marks of finished maps.
    marks: String,
    /// Long side of the matched images, pixels.
    pub resolution: u32,
    pub maps_per_point: usize,
    options: Vec<String>,
    of_maps: Vec<String>,
    of_the_cloud: Vec<String>,
    /// Options with their values, for versions that know them.
    where_known: Vec<[String; 2]>,
    /// Length of the file of each image, bytes: for `run.py`, to notice another picture of the same
    /// name. viewrank itself runs no plan whose images have changed.
    pictures: BTreeMap<String, u64>,
}

/// A view cluster.
#[derive(Serialize, Deserialize)]
pub struct Row {
    rank: usize,
    key: String,
    /// Path of its image, relative to this folder.
    pub image: String,
    /// OpenMVS's ids of key view and partners.
    ids: Vec<u32>,
    pub map: String,
    /// Name and content of the mark of its finished map.
    mark: String,
    id: String,
    /// Long side of the matched images, pixels.
    resolution: u32,
    /// Width and height of the key view's image, pixels.
    pub size: [u32; 2],
    /// Least and greatest depth of the sparse points, scene units.
    depths: [f64; 2],
}

impl Row {
    pub fn new(
        selection: &Selection,
        builder: &Builder,
        (rank, cluster, id): (usize, &RankedCluster, String),
        range: &DepthRange,
    ) -> Self {
        let camera = selection.scene.camera_of(cluster.key);
        let image_id = |view: ViewIndex| selection.scene.view(view).image_id;
        let full = resolution(selection);
        let key = selection.scene.name(cluster.key);
        Self {
            rank,
            key: key.into(),
            image: builder.image(cluster.key),
            ids: cluster.views().map(image_id).collect(),
            map: map_name(image_id(cluster.key)),
            mark: task_marker(key),
            id,
            resolution: match cluster.scale {
                MapScale::Full => full,
                MapScale::Half => full.div_ceil(2),
            },
            size: [camera.width, camera.height],
            depths: [range.least, range.greatest],
        }
    }

    /// Path of its scene in the export.
    pub fn scene(&self) -> String {
        format!("clusters/{:04}.mvs", self.rank)
    }
}

/// Name of the depth map of an image.
pub fn map_name(image_id: u32) -> String {
    format!("depth{image_id:04}.dmap")
}

impl Run {
    pub fn new(
        selection: &Selection,
        options: &ExportOptions,
        clusters: Vec<Row>,
        overlaps: Vec<Vec<usize>>,
        pictures: BTreeMap<String, u64>,
    ) -> Self {
        let texts = |options: &[&str]| options.iter().map(|&word| word.to_owned()).collect();
        let marks = match options.out {
            None => "../dispatch/openmvs/done",
            Some(_) => "done",
        };
        let filter = [FILTER, filter_of(MAPS_PER_POINT.min(clusters.len()))];
        let known = WHERE_KNOWN.iter().chain([&filter]);
        Self {
            clusters,
            overlaps,
            marks: marks.into(),
            resolution: resolution(selection),
            maps_per_point: MAPS_PER_POINT,
            options: texts(&OPTIONS),
            of_maps: texts(&OF_MAPS),
            of_the_cloud: texts(&OF_THE_CLOUD),
            where_known: known.map(|pair| pair.map(str::to_owned)).collect(),
            pictures,
        }
    }

    fn read(call: &Call) -> Result<Self, String> {
        let path = call.workplace.join("run.json");
        let again = |what: String| format!("{}: {what}: export again", path.display());
        let bytes = input::read(&path, FileKind::Plan).map_err(|error| again(error.to_string()))?;
        serde_json::from_slice(&bytes).map_err(|error| again(error.to_string()))
    }

    fn row(&self, rank: usize) -> Result<&Row, String> {
        let row = self.clusters.iter().find(|row| row.rank == rank);
        row.ok_or_else(|| format!("run.json has no rank {rank}: export again"))
    }

    /// Rows of the finished maps, with their indices.
    pub fn finished<'a>(&'a self, call: &'a Call) -> impl Iterator<Item = (usize, &'a Row)> {
        let ranks: BTreeSet<usize> = call.finished.iter().copied().collect();
        let rows = self.clusters.iter().enumerate();
        rows.filter(move |(_, row)| ranks.contains(&row.rank))
    }

    /// Words that every command begins with: works in the folder `work`.
    fn command(&self, call: &Call, work: &Path, scene: &Path, made: &str) -> Vec<OsString> {
        let [config, dense] = ["options.cfg", "dense.cfg"].map(|name| call.workplace.join(name));
        let threads = call.threads.to_string();
        // With a file of options, OpenMVS takes the folder as it is written.
        let work = work.join("");
        let own: [(&str, &Path); 6] = [
            ("--working-folder", &work),
            ("--input-file", scene),
            ("--output-file", Path::new(made)),
            ("--config-file", &config),
            ("--dense-config-file", &dense),
            ("--max-threads", Path::new(&threads)),
        ];
        let own = own
            .into_iter()
            .flat_map(|(name, value)| [name.into(), value.into()]);
        let options = self.options.iter().map(OsString::from);
        [call.program.into()]
            .into_iter()
            .chain(own)
            .chain(options)
            .collect()
    }
}

/// Folder in which the program works on a task.
fn work(call: &Call) -> PathBuf {
    let name = match call.product {
        Product::Map(rank) => format!("{rank:04}"),
        Product::Cloud => "fusion".into(),
    };
    call.workplace.join("unfinished").join(name)
}

/// Makes the folder of a task, and returns the command that does it there.
pub fn commands(call: &Call) -> Result<Vec<Vec<OsString>>, String> {
    let (run, work, disk) = (Run::read(call)?, work(call), call.disk());
    output::make_folder(&call.workplace.join("unfinished"), &disk).map_err(text)?;
    output::make_empty_folder(&work, &disk).map_err(text)?;
    let known = known_options(&run, call.program, &work)?;
    let (mut command, of_task, agreeing, resolution) = match call.product {
        Product::Map(rank) => {
            let row = run.row(rank)?;
            let scene = call.workplace.join(row.scene());
            let command = run.command(call, &work, &scene, "dense.mvs");
            (command, &run.of_maps, run.maps_per_point, row.resolution)
        }
        Product::Cloud => {
            let agreeing = fusion::lay_out(&run, call, &work, &disk)?;
            let mut command = run.command(call, &work, Path::new("fuse.mvs"), "fused.mvs");
            command.extend(["--view-neighbors-file", "fuse.txt"].map(OsString::from));
            command.extend(["--number-views-fuse".into(), agreeing.to_string().into()]);
            (command, &run.of_the_cloud, agreeing, run.resolution)
        }
    };
    command.extend(["--max-resolution".into(), resolution.to_string().into()]);
    command.extend(of_task.iter().map(OsString::from));
    for [option, value] in known {
        let value = match &**option {
            FILTER => filter_of(agreeing).into(),
            _ => value.into(),
        };
        command.extend([option.into(), value]);
    }
    Ok(vec![command])
}

/// Value of [`FILTER`] where so many maps must agree.
fn filter_of(agreeing: usize) -> &'static str {
    if agreeing < 2 { "0" } else { "1" }
}

pub fn text(error: impl std::fmt::Display) -> String {
    error.to_string()
}

/// Returns those of the options that only some versions know which this program names in its help.
/// It writes a log even then, to the folder `work`.
fn known_options<'a>(
    run: &'a Run,
    program: &Path,
    work: &Path,
) -> Result<Vec<&'a [String; 2]>, String> {
    let failed = |error: std::io::Error| format!("{}: {error}", program.display());
    let asked = platform::command(program)
        .map_err(failed)?
        .arg("--help")
        .current_dir(work)
        .stdin(std::process::Stdio::null())
        .output()
        .map_err(failed)?;
    let help = [asked.stdout, asked.stderr].concat();
    let help = String::from_utf8_lossy(&help);
    let is_known = |pair: &&[String; 2]| help.contains(&*pair[0]);
    Ok(run.where_known.iter().filter(is_known).collect())
}

/// Checks what the program has made, and puts it in its place.
pub fn finish(call: &Call) -> Result<(), String> {
    let (run, work, disk) = (Run::read(call)?, work(call), call.disk());
    let made = match call.product {
        Product::Map(rank) => {
            let row = run.row(rank)?;
            check(row, &work.join(&row.map))?;
            refuse_other_kinds(&run, row, call, &work)?;
            vec![row.map.clone()]
        }
        Product::Cloud => ["fused.mvs", "fused.ply"].map(str::to_owned).into(),
    };
    for name in made {
        output::rename(&work.join(&name), &call.workplace.join(&name), &disk).map_err(text)?;
    }
    output::remove_folder(&work, &disk).map_err(text)
}

/// Fails unless the map is what the plan asked for.
fn check(row: &Row, path: &Path) -> Result<(), String> {
    if !path.exists() {
        return Err("OpenMVS made no depth map".into());
    }
    let map = WholeMap::read(path, row.size).map_err(text)?;
    let sorted = |ids: &[u32]| -> Vec<u32> {
        BTreeSet::from_iter(ids.iter().copied())
            .into_iter()
            .collect()
    };
    let (key, partners) = map.ids().split_first().unwrap_or((&u32::MAX, &[]));
    if *key != row.ids[0] {
        return Err(format!(
            "the depth map is of image {key}, not of {}",
            row.ids[0]
        ));
    }
    let (made, planned) = (sorted(partners), sorted(&row.ids[1..]));
    if made != planned {
        return Err(format!(
            "OpenMVS matched the partners {made:?} instead of {planned:?}"
        ));
    }
    let [least, greatest] = map.range();
    let [nearest, farthest] = row.depths;
    let is_searched = (RANGE[0] * nearest..=1.001 * nearest).contains(&least)
        && (0.999 * farthest..=RANGE[1] * farthest).contains(&greatest);
    if !is_searched {
        return Err(format!(
            "OpenMVS searched depths of {least} to {greatest}, but the sparse points have {nearest} to {farthest}"
        ));
    }
    let filled = map.filled().map_err(text)?;
    if filled < LEAST_FILLED {
        return Err(format!(
            "only {:.1} % of the pixels have a depth",
            100.0 * filled
        ));
    }
    Ok(())
}

/// Fails if a finished map is of another kind than the one just made.
fn refuse_other_kinds(run: &Run, row: &Row, call: &Call, work: &Path) -> Result<(), String> {
    let kind = WholeMap::read(&work.join(&row.map), row.size)
        .map_err(text)?
        .kind();
    let others = run
        .finished(call)
        .filter(|(_, other)| other.rank != row.rank);
    let other = others.filter_map(|(_, other)| {
        let map = WholeMap::read(&call.workplace.join(&other.map), other.size).ok()?;
        Some((map.kind(), &*other.map))
    });
    let found: BTreeMap<&str, &str> = other.take(1).chain([(kind, "the new map")]).collect();
    fusion::refuse_two_kinds(&found)
}
