//! The tasks of an export: `run.json`, and how DensifyPointCloud computes and fuses what it lists.
//!
//! A map is made in `unfinished/`, and moved to its place if it is what the plan asked for:
//! DensifyPointCloud exits with 0 whatever it did. The cloud is made there too, from links to the
//! maps that are finished.

use std::{
    collections::{BTreeMap, BTreeSet},
    ffi::OsString,
    path::Path,
    process::Stdio,
};

use serde::{Deserialize, Serialize};

use super::{
    MAPS_PER_POINT, fusion, resolution,
    scene::{Builder, DepthRange},
};
use crate::{
    backends::{
        Call, Product, Selection,
        clusters::task_marker,
        runner::{refuse_empty, text},
    },
    base::platform,
    io::{depthmaps::openmvs::WholeMap, output},
    model::{
        cluster::{MapScale, RankedCluster},
        scene::ViewIndex,
    },
};

/// Bounds on the searched range over [`Row::depths`]: OpenMVS takes 0.9 and 1.1 times that.
const RANGE: [f64; 2] = [0.8, 1.25];

/// Options of every run of DensifyPointCloud: all views, none reduced by a level.
const OPTIONS: [&str; 10] = [
    "--verbosity",
    "1",
    // The size of the images comes from `--max-resolution` alone.
    "--resolution-level",
    "0",
    "--min-resolution",
    "16",
    // By default 5 partners are taken, or 8 with CUDA.
    "--number-views",
    "0",
    // The partners have no maps.
    "--geometric-iters",
    "0",
];
/// Filter 3: speckles and gaps, without the one that needs the partners' maps.
const OF_MAPS: [&str; 4] = ["--fusion-mode", "1", "--postprocess-dmaps", "3"];
const OF_THE_CLOUD: [&str; 2] = ["--postprocess-dmaps", "0"];
/// `options.cfg`: OpenMVS would read one that somebody left in the folder of the map.
pub const NO_OPTIONS: &str = "# Options of DensifyPointCloud come from its command line alone.\n";

pub const RUN: &str = "run.json";

/// Content of `run.json`.
#[derive(Serialize, Deserialize)]
pub struct Run {
    pub clusters: Vec<Row>,
    /// For each image of `fuse.mvs`, the indices of the key views that overlap it, best first, as
    /// many as a fusion of the first maps may need; empty if it is not a key view.
    pub overlaps: Vec<Vec<usize>>,
    /// Long side of the matched images, pixels.
    pub resolution: u32,
    pub maps_per_point: usize,
    /// Read by `run.py` alone.
    #[serde(flatten, skip_deserializing)]
    of_script: OfScript,
}

/// Fields for the script alone, which viewrank has without the file.
#[derive(Default, Serialize)]
struct OfScript {
    options: Vec<&'static str>,
    of_maps: Vec<&'static str>,
    of_the_cloud: Vec<&'static str>,
    /// Options with their values, for versions that know them.
    where_known: Vec<[&'static str; 2]>,
    /// Length of the file of each image, bytes, to notice another picture of the same name.
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
    /// Name of the mark of its finished map, and what it says: the first where this one is made.
    mark: String,
    ids_of_map: [String; 2],
    /// Long side of the matched images, pixels.
    resolution: u32,
    /// Width and height of the key view's image, pixels.
    pub size: [u32; 2],
    /// Least and greatest depth of the sparse points, scene units.
    depths: [f64; 2],
}

impl Row {
    /// Its rank, and the content of the mark of its map.
    fn task(&self) -> (usize, &str) {
        (self.rank, &self.ids_of_map[0])
    }

    pub fn new(
        selection: &Selection,
        builder: &Builder,
        (rank, cluster, ids_of_map): (usize, &RankedCluster, [String; 2]),
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
            ids_of_map,
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
        clusters: Vec<Row>,
        overlaps: Vec<Vec<usize>>,
        pictures: BTreeMap<String, u64>,
    ) -> Self {
        let of_script = OfScript {
            options: OPTIONS.into(),
            of_maps: OF_MAPS.into(),
            of_the_cloud: OF_THE_CLOUD.into(),
            where_known: where_known(MAPS_PER_POINT.min(clusters.len())).into(),
            pictures,
        };
        Self {
            clusters,
            overlaps,
            resolution: resolution(selection),
            maps_per_point: MAPS_PER_POINT,
            of_script,
        }
    }

    /// Rows of the finished maps, with their indices.
    pub fn finished(&self, call: &Call) -> impl Iterator<Item = (usize, &Row)> {
        let rows = self.clusters.iter().enumerate();
        rows.filter(|(_, row)| call.is_finished(row.rank))
    }
}

/// Returns the start of every command: the program, its files and the options of all.
fn command_on(call: &Call, scene: &Path, made: &str) -> Vec<OsString> {
    let [config, dense] = ["options.cfg", "dense.cfg"].map(|name| call.workplace.join(name));
    let threads = call.threads.to_string();
    // With a file of options, OpenMVS takes the folder as it is written.
    let work = call.work.join("");
    let files: [(&str, &Path); 6] = [
        ("--working-folder", &work),
        ("--input-file", scene),
        ("--output-file", Path::new(made)),
        ("--config-file", &config),
        ("--dense-config-file", &dense),
        ("--max-threads", Path::new(&threads)),
    ];
    let files = files.into_iter();
    let files = files.flat_map(|(name, value)| [name.into(), value.into()]);
    let options = OPTIONS.map(OsString::from);
    [call.program.into()]
        .into_iter()
        .chain(files)
        .chain(options)
        .collect()
}

/// Makes the folder of a task, and returns the command that does it there.
pub fn commands(call: &Call) -> Result<Vec<Vec<OsString>>, String> {
    let run: Run = call.read(RUN)?;
    output::make_new_folder(call.work, &call.disk()).map_err(text)?;
    let help = help_of(call)?;
    let (mut command, of_task, agreeing, resolution) = match call.product {
        Product::Map(rank) => {
            let row = call.row_of(rank, &run.clusters, Row::task)?;
            let scene = call.workplace.join(row.scene());
            let command = command_on(call, &scene, "dense.mvs");
            (command, &OF_MAPS[..], run.maps_per_point, row.resolution)
        }
        Product::Cloud => {
            let agreeing = fusion::lay_out(&run, call)?;
            let mut command = command_on(call, Path::new("fuse.mvs"), "fused.mvs");
            command.extend(["--view-neighbors-file", "fuse.txt"].map(OsString::from));
            command.extend(["--number-views-fuse".into(), agreeing.to_string().into()]);
            (command, &OF_THE_CLOUD[..], agreeing, run.resolution)
        }
    };
    command.extend(["--max-resolution".into(), resolution.to_string().into()]);
    command.extend(of_task.iter().map(OsString::from));
    let known = where_known(agreeing);
    let known = known.iter().filter(|[option, _]| help.contains(option));
    command.extend(known.flatten().map(OsString::from));
    Ok(vec![command])
}

/// Returns the options that not all versions have, with their values. `agreeing`: number of maps
/// that must agree on a point.
///
/// With them nothing is cut off or filled in around the sparse points. Filter 1 keeps what two maps
/// agree on, filter 0 everything; filter 2, the default since v2.4.0, needs five pixels for a
/// point.
fn where_known(agreeing: usize) -> [[&'static str; 2]; 4] {
    [
        ["--estimate-roi", "0"],
        ["--crop-to-roi", "0"],
        ["--tower-mode", "0"],
        ["--fusion-filter", if agreeing < 2 { "0" } else { "1" }],
    ]
}

/// Returns the program's help, which names the options that it knows. It writes a log even then.
fn help_of(call: &Call) -> Result<String, String> {
    let failed = |error: std::io::Error| format!("{}: {error}", call.program.display());
    let asked = platform::command(call.program)
        .map_err(failed)?
        .arg("--help")
        .current_dir(call.work)
        .stdin(Stdio::null())
        .output()
        .map_err(failed)?;
    let help = [asked.stdout, asked.stderr].concat();
    Ok(String::from_utf8_lossy(&help).into_owned())
}

/// Checks what the program has made, and puts it in its place.
pub fn finish(call: &Call) -> Result<(), String> {
    match call.product {
        Product::Map(rank) => {
            let run: Run = call.read(RUN)?;
            let row = call.row_of(rank, &run.clusters, Row::task)?;
            let kind = check(row, &call.work.join(&row.map))?;
            refuse_other_kinds(&run, row, call, kind)?;
            call.place(&row.map)
        }
        Product::Cloud => {
            fusion::check(call.work)?;
            call.place("fused.ply")?;
            call.place("fused.mvs")
        }
    }
}

/// Fails unless the map is what the plan asked for; returns its kind.
fn check(row: &Row, path: &Path) -> Result<&'static str, String> {
    if !path.exists() {
        return Err("OpenMVS made no depth map".into());
    }
    let map = WholeMap::read(path, row.size).map_err(text)?;
    let set = |ids: &[u32]| BTreeSet::from_iter(ids.iter().copied());
    let (key, partners) = map.ids().split_first().unwrap_or((&u32::MAX, &[]));
    let (own, planned) = row.ids.split_first().unwrap_or((&u32::MAX, &[]));
    if key != own {
        return Err(format!("the depth map is of image {key}, not of {own}"));
    }
    // As sets, since OpenMVS orders the partners by scores of its own.
    let (made, planned) = (set(partners), set(planned));
    if made != planned {
        return Err(format!(
            "OpenMVS matched the partners {made:?} instead of {planned:?}"
        ));
    }
    let [least, greatest] = map.range();
    let [nearest, farthest] = row.depths;
    // OpenMVS may search 0.1 to 100 units whatever the scene has, and ends with 0 all the same.
    let is_searched = (RANGE[0] * nearest..=1.001 * nearest).contains(&least)
        && (0.999 * farthest..=RANGE[1] * farthest).contains(&greatest);
    if !is_searched {
        return Err(format!(
            "OpenMVS searched depths of {least} to {greatest}, but the sparse points have {nearest} to {farthest}"
        ));
    }
    refuse_empty(map.filled().map_err(text)?)?;
    Ok(map.kind())
}

/// Fails if a map that is there is of another kind than the one just made.
fn refuse_other_kinds(run: &Run, row: &Row, call: &Call, kind: &str) -> Result<(), String> {
    let others = run.clusters.iter().filter(|other| other.rank != row.rank);
    // One other map suffices: each was compared with one when it was made.
    let mut others = others.filter_map(|other| {
        let map = WholeMap::read(&call.workplace.join(&other.map), other.size).ok()?;
        Some((map.kind(), &*other.map))
    });
    let found: BTreeMap<&str, &str> = others
        .next()
        .into_iter()
        .chain([(kind, "the new map")])
        .collect();
    fusion::refuse_two_kinds(&found)
}
