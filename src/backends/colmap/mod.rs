//! COLMAP's dense stereo, 3.8 to 4.2: `docs/backends.md` 1.
//!
//! `stereo/patch-match.cfg` always runs through with the options at its head,
//! `stereo/viewrank/run.sh` runs all steps where there is no viewrank, and [`run`] does them one by
//! one and checks each. The difficulty is geometric consistency: it needs the
//! photometric depth maps of every partner, and a partner that isn't a reference image never gets
//! one. There are four variants, by [`ExportOptions::refs`] and [`ExportOptions::geometric`]:
//!
//! | refs | geometric | depth maps |
//! | --- | --- | --- |
//! | keys | off | photometric of the key views, with exactly their partners |
//! | keys+partners | on | photometric of key views and partners, then geometric of the key views, with exactly their partners |
//! | keys | on | photometric of the key views, then geometric with those partners that are key views |
//! | all | on or off | every view: key views first, with exactly their partners |
//!
//! With geometric consistency the ranked list is cut into batches, so that an interrupted run
//! leaves complete results of the best clusters.

use std::{
    collections::{HashMap, HashSet},
    path::Path,
};

use nalgebra::Vector3;

use self::{
    cfg::Problem,
    marks::{ListedMap, map_name},
    run::{Row, Run},
};
use super::{
    Backend, BackendError, Capabilities, ExaminedProject, Export, ExportOptions, ExportRecord,
    Honours, LastRun, PATCH_MATCH, PlanningNumbers, References, Selection, TaskProgram, TaskRunner,
    Tasks, Trap,
    clusters::task_ids,
    record::{at_full_size, capped_scale},
    selection,
    strangers::with_refusal,
    workspace::{Workspace, add_workspace},
};
use crate::{
    base::printable::to_json,
    io::{
        output::{Contents, FileSet},
        project::ProjectKind,
    },
    model::{
        cluster::{MapScale, RankedCluster},
        scene::{Scene, ViewIndex},
    },
};

mod cfg;
mod marks;
mod run;
mod traps;
mod widths;

/// Maps that must agree on a point. COLMAP's default of 5 gives 40 to 74 % of the surface that 2
/// does, 3 to 12 points more accurate (docs/benchmarks.md), and how many maps see a place depends
/// on the plan.
const MIN_PIXELS: usize = 2;
/// Folder of viewrank's own files in the workspace.
const OWN: &str = "stereo/viewrank/";
const MARKS: &str = "stereo/viewrank/marks.tsv";
const SCRIPT: &str = "stereo/viewrank/run.sh";
/// Options of photometric maps from which no geometric pass starts.
const PHOTOMETRIC: &str = "--PatchMatchStereo.geom_consistency 0 --PatchMatchStereo.filter 1";
/// Path of the cloud: `fused.ply` in the workspace itself may be the user's.
const FUSED: &str = "stereo/viewrank/fused.ply";
/// List that COLMAP reads by default.
const MAIN_LIST: &str = "stereo/patch-match.cfg";
/// Key views per batch of a run with geometric consistency.
const BATCH: usize = 10;

pub static BACKEND: Backend = Backend {
    name: "colmap",
    program: "COLMAP",
    last_run: LastRun::At {
        date: "2026-11-28",
        version: "3.8, 4.2.1 (CPU)",
        what: "models and fusion; patch_match_stereo never: it needs a GPU",
    },
    capabilities: Capabilities {
        partners: Honours::Yes,
        key_subset: Honours::Yes,
        order: Honours::Yes,
        fusion: "stereo_fusion of the key views' maps, by stereo/fusion.cfg",
        notes: "partners are a set, their order is lost; the order of key views is exact with one GPU; geometric consistency \
                needs photometric maps of the partners too (--refs keys+partners)",
    },
    planning: PlanningNumbers {
        measured: "1 set, in part",
        caution: None,
        source: "agreement: 128 photometric maps of COLMAP of a room; 3 degrees is its filter_min_triangulation_angle; gate and \
                 geometric confidence: the numbers of OpenMVS, the other PatchMatch (method 7.1, 7.2); support 2: stereo_fusion joins what at least min_num_pixels maps see, \
                 which the runner sets to 2",
        ..PATCH_MATCH
    },
    options: &["--refs", "--geometric"],
    mixes_sizes: true,
    serves: |project| {
        let is_itself = project.kind == ProjectKind::ColmapDense;
        is_itself || project.undistorted_workspace().is_some()
    },
    tasks: Some(Tasks {
        program: TaskProgram {
            name: "colmap",
            variable: "COLMAP",
        },
        runner: tasks,
    }),
    known_maps: marks::known,
    traps,
    export,
    ..Backend::DEFAULT
};

fn tasks(selection: &Selection, export: &Export) -> TaskRunner {
    let workspace = selection.project.dense_workspace.as_deref();
    let workspace = workspace.filter(|workspace| *workspace == export.files.root);
    let names = ListedNames::new(selection, workspace);
    let passes = Passes::new(&names, selection, &ExportOptions::default());
    let made: HashSet<&str> = passes
        .last
        .iter()
        .map(|problem| &*problem.reference)
        .collect();
    let map = |c: &RankedCluster| {
        let name = names.of(c.key);
        let path = format!("stereo/depth_maps/{}", map_name(name, "photometric"));
        // Without points or partners there is no problem in the list, and no map to wait for.
        made.contains(name).then(|| export.files.root.join(path))
    };
    TaskRunner {
        python: None,
        commands: run::commands,
        is_whole: run::is_whole,
        finish: run::finish,
        lists: &[run::RUN],
        own: OWN,
        clouds: vec![export.files.root.join(FUSED)],
        sizes_share_a_file: true,
        maps: selection.clusters.iter().map(map).collect(),
    }
}

fn traps(examined: &ExaminedProject) -> Vec<Trap> {
    traps::all(examined)
}

fn export(selection: &Selection, options: &ExportOptions) -> Result<Export, BackendError> {
    let workspace = selection.project.dense_workspace.as_deref();
    let workspace = workspace.filter(|_| options.out.is_none());
    let names = ListedNames::new(selection, workspace);
    let passes = Passes::new(&names, selection, options);
    // All names in the lists: `--refs all` lists views of no cluster.
    passes.names().try_for_each(cfg::check_listed)?;
    let mut record = ExportRecord::new(&BACKEND, selection, |v| selection.scene.name(v).into());
    passes.describe(selection, &mut record);
    let mut files = match workspace {
        Some(workspace) => {
            selection.refuse_unusable_images(BACKEND.name)?;
            record.warnings.extend(traps::rounded(selection.scene));
            FileSet::new(workspace, BACKEND.name)
        }
        None => {
            let origin = selection.near_origin().origin;
            record.moved(origin);
            own_workspace(selection, options, passes.refs, origin)?
        }
    };
    passes.add_files(selection, &mut files, &mut record);
    let listed = passes.listed_maps(selection);
    files.add_text(MARKS, marks::to_tsv(&listed));
    files.add_script(SCRIPT, script(&record, listed.len()));
    files.add_text("stereo/viewrank/export.json", record.to_json());
    Ok(Export { files, record })
}

/// Adds a separate dense workspace with the images of the clusters.
fn own_workspace(
    selection: &Selection,
    options: &ExportOptions,
    refs: References,
    origin: Vector3<f64>,
) -> Result<FileSet, BackendError> {
    selection.undistorted_images(BACKEND.name)?;
    let views = match refs {
        References::All => selection.scene.view_indices().collect(),
        _ => selection.views(),
    };
    let mut files = options.file_set(&BACKEND, selection);
    // Points that a single view observes are kept: COLMAP derives the depth range of a view from
    // all of its points.
    add_workspace(
        BACKEND.name,
        &mut files,
        selection,
        Workspace {
            views: &views,
            tests: &[],
            least_views: 1,
            model: "sparse",
            images: Some(("images", selection.images(BACKEND.name)?)),
        },
        origin,
    )?;
    Ok(files)
}

/// The names of views in the lists: COLMAP goes by the names in the model of its workspace.
struct ListedNames<'a> {
    scene: &'a Scene,
    /// Those that differ, by the names in the scene.
    others: HashMap<String, String>,
}

impl<'a> ListedNames<'a> {
    /// `workspace`: the project's own, if the lists are for it, rather than for a new one.
    fn new(selection: &Selection<'a>, workspace: Option<&Path>) -> Self {
        let others = workspace.map(|_| selection.project.names_in_workspace());
        Self {
            scene: selection.scene,
            others: others.unwrap_or_default(),
        }
    }

    fn of(&self, view: ViewIndex) -> &str {
        let name = self.scene.name(view);
        self.others.get(name).map_or(name, String::as_str)
    }
}

/// The problems of patch match, each list in the order of computation.
struct Passes<'a> {
    names: &'a ListedNames<'a>,
    refs: References,
    geometric: bool,
    /// First, photometric pass, if a geometric one follows.
    first: Vec<Problem>,
    /// Last pass, whose maps are fused.
    last: Vec<Problem>,
    /// References of the last pass that are matched at half the size; empty if maps start from
    /// those of others.
    half: HashSet<String>,
}

impl<'a> Passes<'a> {
    fn new(names: &'a ListedNames, selection: &Selection, options: &ExportOptions) -> Self {
        let geometric = options
            .geometric
            .unwrap_or(options.refs == Some(References::KeysAndPartners));
        let refs = options.refs.unwrap_or(if geometric {
            References::KeysAndPartners
        } else {
            References::Keys
        });
        let with_points = views_with_points(selection);
        let keys = key_problems(names, selection, &with_points);
        let others = other_problems(names, selection, refs, &with_points);
        let all = [keys.clone(), others].concat();
        let (first, last) = match (geometric, refs) {
            (false, _) => (Vec::new(), all),
            (true, References::Keys) => {
                let last = with_sources_among(&keys, &keys);
                (keys, last)
            }
            (true, References::KeysAndPartners) => {
                let last = with_sources_among(&keys, &all);
                (all, last)
            }
            (true, References::All) => (all.clone(), with_sources_among(&all, &all)),
        };
        let at_half = selection
            .clusters
            .iter()
            .filter(|c| !geometric && c.scale == MapScale::Half);
        let half = at_half.map(|c| names.of(c.key).to_owned()).collect();
        Self {
            names,
            refs,
            geometric,
            first,
            last,
            half,
        }
    }

    /// Returns all names in the lists.
    fn names(&self) -> impl Iterator<Item = &str> {
        let problems = self.first.iter().chain(&self.last);
        problems.flat_map(Problem::names)
    }

    /// Returns a list that can be run with COLMAP's default options, or with `geom_consistency 0`
    /// if not geometric.
    fn main_list(&self) -> &[Problem] {
        // By default COLMAP runs both passes over one list, in which every source must be a
        // reference.
        if self.geometric && self.refs != References::Keys {
            &self.first
        } else {
            &self.last
        }
    }

    fn describe(&self, selection: &Selection, record: &mut ExportRecord) {
        let last: HashSet<&str> = self.last.iter().map(|p| p.reference.as_str()).collect();
        let maps = if self.geometric {
            // Of the first pass, only the maps that some batch needs are made.
            self.batches().iter().map(|(first, _)| first.len()).sum()
        } else {
            self.last.len()
        };
        record.runner = Some(SCRIPT.into());
        record.made_for = "COLMAP 3.8 to 4.2 (models and fusion run with 3.8 and 4.2.1)".into();
        record.way = format!(
            "refs {}, geometric {}",
            serde_json::to_value(self.refs)
                .expect("a plain enum")
                .as_str()
                .unwrap_or_default(),
            if self.geometric { "on" } else { "off" }
        );
        record
            .not_honoured
            .push("the order of the partners of a key view".into());
        if self.geometric {
            record.warnings.extend(at_full_size(selection));
        }
        // Key views without points or partners get none.
        record.key_maps = selection
            .clusters
            .iter()
            .filter(|c| last.contains(self.names.of(c.key)))
            .count();
        record.other_maps = maps - record.key_maps.min(maps);
        record.note_scale(selection, capped_scale(size_cap(selection)));
        let with_points = views_with_points(selection);
        for cluster in selection.clusters {
            if !last.contains(self.names.of(cluster.key)) {
                let key = selection.scene.name(cluster.key);
                let why = self.left_out(cluster, &with_points);
                record
                    .warnings
                    .push(format!("{key}: {why}, so no depth map"));
            }
        }
        record.warnings.extend(widths::warning(selection));
        if self.geometric && self.refs == References::Keys {
            record.not_honoured.push(
                "partners that are no key views take part in the photometric pass only".into(),
            );
        }
    }

    /// Returns the reason why a key view gets no depth map.
    fn left_out(&self, cluster: &RankedCluster, with_points: &[bool]) -> &'static str {
        if !with_points[cluster.key.index()] {
            "it observes no sparse point in front of it, which COLMAP takes the depth range from"
        } else if cluster.partners.is_empty() {
            "it has no partner"
        } else if self.refs == References::Keys {
            "no partner is a key view with a photometric map, which geometric consistency needs"
        } else {
            "no partner has a photometric map, which geometric consistency needs"
        }
    }

    fn add_files(&self, selection: &Selection, files: &mut FileSet, record: &mut ExportRecord) {
        let heading = [
            format!(
                "viewrank, {}: references in rank order, each followed by its partners",
                record.way
            ),
            format!("patch_match_stereo {}", geometric(self.geometric).trim()),
        ];
        files.add_text(
            MAIN_LIST,
            cfg::write_patch_match(&heading, self.main_list()),
        );
        let fused: String = self
            .last
            .iter()
            .map(|p| p.reference.clone() + "\n")
            .collect();
        // Without a heading: COLMAP takes each line of this file for a name.
        files.add_text("stereo/fusion.cfg", fused);
        let passes = if self.geometric {
            self.add_batches(selection, files)
        } else {
            self.add_lists(selection, files)
        };
        record.commands.extend(passes);
        self.add_fusion(selection, record);
        if !self.geometric {
            files.add_text(run::RUN, to_json(&self.run(selection)));
        }
        for folder in map_folders(self.first.iter().chain(&self.last)) {
            files.add(folder, Contents::Folder);
        }
    }

    /// Returns the tasks of an export without geometric consistency.
    fn run(&self, selection: &Selection) -> Run {
        let problems: HashMap<&str, &Problem> =
            self.last.iter().map(|p| (&*p.reference, p)).collect();
        let row = |(rank, cluster): (usize, &RankedCluster)| {
            let problem = *problems.get(self.names.of(cluster.key))?;
            let [id, id_at_full_size] = task_ids(&BACKEND, selection, cluster);
            let max_image_size = max_image_size(selection, cluster.scale);
            let camera = selection.scene.camera_of(cluster.key);
            Some(Row {
                rank,
                id,
                id_at_full_size,
                problem: problem.clone(),
                max_image_size,
                size: reduced([camera.width, camera.height], max_image_size),
            })
        };
        Run {
            images: selection.scene.views.len(),
            maps: (1..).zip(selection.clusters).filter_map(row).collect(),
        }
    }

    /// Adds the lists of the two passes with geometric consistency, batch by batch; returns their
    /// commands.
    fn add_batches(&self, selection: &Selection, files: &mut FileSet) -> Vec<String> {
        let mut commands = Vec::new();
        for (i, (first, last)) in self.batches().iter().enumerate() {
            let name = |pass| format!("stereo/viewrank/{:04}-{pass}.cfg", i + 1);
            let command =
                |pass, options: &str| patch_match(selection, &name(pass), options, MapScale::Full);
            if !first.is_empty() {
                files.add_text(name("photometric"), cfg::write_patch_match(&[], first));
                // COLMAP does not filter the photometric maps of its own two passes either.
                let options = geometric(false) + "--PatchMatchStereo.filter 0";
                commands.push(command("photometric", &options));
            }
            files.add_text(name("geometric"), cfg::write_patch_match(&[], last));
            commands.push(command("geometric", geometric(true).trim()));
        }
        commands
    }

    /// Adds the lists of the only pass without geometric consistency, one for each run of maps of
    /// one size; returns their commands.
    fn add_lists(&self, selection: &Selection, files: &mut FileSet) -> Vec<String> {
        let mut commands = Vec::new();
        for (config, scale, problems) in self.lists_of_one_size() {
            commands.push(patch_match(selection, &config, PHOTOMETRIC, scale));
            if config != MAIN_LIST {
                files.add_text(config, cfg::write_patch_match(&[], problems));
            }
        }
        commands
    }

    fn scale(&self, problem: &Problem) -> MapScale {
        if self.half.contains(&problem.reference) {
            MapScale::Half
        } else {
            MapScale::Full
        }
    }

    /// Returns all depth maps of the lists, with their marks.
    fn listed_maps(&self, selection: &Selection) -> Vec<ListedMap> {
        let clusters = selection.clusters.iter();
        let tasks: HashMap<&str, &RankedCluster> =
            clusters.map(|c| (self.names.of(c.key), c)).collect();
        let listed = |problem: &Problem, kind: &str, filter: &str| {
            let size = max_image_size(selection, self.scale(problem));
            ListedMap::new(problem, kind, &format!("{filter} {size:?}"))
        };
        let last = |problem: &Problem| {
            if self.geometric {
                return listed(problem, "geometric", "filter 1");
            }
            let mut map = listed(problem, "photometric", "filter 1");
            if let Some(task) = tasks.get(&*problem.reference) {
                // The mark of the task, so that `viewrank run` goes on from maps of `run.sh`, and
                // vice versa.
                [map.id, _] = task_ids(&BACKEND, selection, task);
            }
            map
        };
        let first = self
            .first
            .iter()
            .map(|problem| listed(problem, "photometric", "filter 0"));
        first.chain(self.last.iter().map(last)).collect()
    }

    /// Lists of key views of one size each, in the order of computation, with their paths: the main
    /// list where all have full size.
    fn lists_of_one_size(&self) -> Vec<(String, MapScale, &[Problem])> {
        if self.half.is_empty() {
            return vec![(MAIN_LIST.into(), MapScale::Full, &self.last)];
        }
        // A call has one `max_image_size`. Two lists, one per size, would need fewer calls but lose
        // the rank order.
        let of_one_size = |a: &Problem, b: &Problem| self.scale(a) == self.scale(b);
        let lists = self.last.chunk_by(of_one_size).zip(1..);
        lists
            .map(|(list, n)| (format!("{OWN}{n:04}.cfg"), self.scale(&list[0]), list))
            .collect()
    }

    /// Splits the last pass into batches of [`BATCH`], each with the photometric maps that it needs
    /// and that no earlier batch makes.
    fn batches(&self) -> Vec<(Vec<Problem>, Vec<Problem>)> {
        let mut made = HashSet::new();
        let batch = |last: &[Problem]| {
            let needed: HashSet<&str> = last
                .iter()
                .flat_map(|p| std::iter::once(&p.reference).chain(&p.sources))
                .map(String::as_str)
                .collect();
            let wanted = |p: &&Problem| {
                // Inserted only if needed: what this batch leaves out, a later one makes.
                needed.contains(p.reference.as_str()) && made.insert(p.reference.clone())
            };
            (
                self.first.iter().filter(wanted).cloned().collect(),
                last.to_vec(),
            )
        };
        self.last.chunks(BATCH).map(batch).collect()
    }

    fn add_fusion(&self, selection: &Selection, record: &mut ExportRecord) {
        let kind = if self.geometric {
            "geometric"
        } else {
            "photometric"
        };
        let options = fusion_options(kind, self.last.len(), selection.scene.views.len());
        record.commands.push(format!(
            "colmap stereo_fusion --workspace_path . {options} --output_path {FUSED}"
        ));
        let min_pixels = min_pixels(self.last.len());
        record.fusion = format!(
            "min_num_pixels {min_pixels}: COLMAP's default of 5 leaves nothing where fewer key views see a place; check_num_images: key views are joined although other views overlap them more"
        );
    }
}

/// Returns how many maps must agree on a point: with a single map no other can.
fn min_pixels(maps: usize) -> usize {
    MIN_PIXELS.min(maps.max(1))
}

/// Options of a fusion of maps of one kind. `images`: number of those of the model.
fn fusion_options(kind: &str, maps: usize, images: usize) -> String {
    format!(
        // COLMAP takes a view's neighbours among all images of the model, and only then drops those
        // without a map. With its default of 50, key views could lose each other.
        "--input_type {kind} --StereoFusion.min_num_pixels {} --StereoFusion.check_num_images {images}",
        min_pixels(maps)
    )
}

/// Returns `run.sh`, which runs the commands of the record in the workspace. `lines`: those of the
/// list of marks.
fn script(record: &ExportRecord, lines: usize) -> String {
    let (fusion, maps) = record.commands.split_last().expect("the maps are fused");
    let command = |c: &String| c.replacen("colmap", "\"${COLMAP:-colmap}\"", 1);
    let maps: Vec<String> = maps.iter().map(command).collect();
    // The script moves the cloud to its place when it is whole.
    let unfinished = format!("{OWN}unfinished.ply");
    with_refusal(include_str!("../../../integrations/colmap/run.sh"))
        .replacen("@LINES@", &lines.to_string(), 1)
        .replacen("@MAPS@", &maps.join("\n"), 1)
        .replacen("@FUSION@", &command(fusion).replace(FUSED, &unfinished), 1)
}

/// Returns, for each view, whether it observes a sparse point. COLMAP derives the depth range from
/// these and aborts at a view without any.
fn views_with_points(selection: &Selection) -> Vec<bool> {
    let points = selection.scene.view_points();
    selection
        .scene
        .view_indices()
        .map(|v| !selection::depths(selection.scene, &points, v).is_empty())
        .collect()
}

/// Returns the chosen clusters as problems, in rank order.
fn key_problems(names: &ListedNames, selection: &Selection, with_points: &[bool]) -> Vec<Problem> {
    let name = |v: ViewIndex| names.of(v).to_owned();
    let problem = |c: &RankedCluster| Problem {
        reference: name(c.key),
        sources: c.partners.iter().map(|&p| name(p)).collect(),
    };
    selection
        .clusters
        .iter()
        // COLMAP ends the whole run at a view without points, and an empty line of sources would
        // shift all later pairs.
        .filter(|c| with_points[c.key.index()] && !c.partners.is_empty())
        .map(problem)
        .collect()
}

/// Returns problems for views that aren't key views but need a depth map, by name; their sources
/// are the views with most shared points that get maps, too.
fn other_problems(
    names: &ListedNames,
    selection: &Selection,
    refs: References,
    with_points: &[bool],
) -> Vec<Problem> {
    let scene = selection.scene;
    let views = match refs {
        References::Keys => return Vec::new(),
        References::KeysAndPartners => selection.views(),
        References::All => scene.view_indices().collect(),
    };
    let is_key = selection.is_key();
    let points = scene.view_points();
    let count = selection.most_partners().max(1);
    let problem = |&v: &ViewIndex| {
        let shared = selection::shared_points(scene, &points, v);
        let mut sources: Vec<_> = views
            .iter()
            .copied()
            .filter(|s| shared[s.index()] > 0 && with_points[s.index()])
            .collect();
        // A stable sort: views that share equally many points stay in the order of their names.
        sources.sort_by_key(|s| std::cmp::Reverse(shared[s.index()]));
        sources.truncate(count);
        Problem {
            reference: names.of(v).into(),
            sources: sources
                .into_iter()
                .map(|s| names.of(s).to_owned())
                .collect(),
        }
    };
    let others = views
        .iter()
        .filter(|v| !is_key[v.index()] && with_points[v.index()]);
    others
        .map(problem)
        .filter(|p| !p.sources.is_empty())
        .collect()
}

/// Returns the problems with only those sources that are references of `among`; problems without
/// any are omitted.
fn with_sources_among(problems: &[Problem], among: &[Problem]) -> Vec<Problem> {
    let references: HashSet<&str> = among.iter().map(|p| p.reference.as_str()).collect();
    // COLMAP aborts a geometric pass where a source has no photometric map.
    let reduced = |p: &Problem| Problem {
        reference: p.reference.clone(),
        sources: p
            .sources
            .iter()
            .filter(|s| references.contains(s.as_str()))
            .cloned()
            .collect(),
    };
    problems
        .iter()
        .map(reduced)
        .filter(|p| !p.sources.is_empty())
        .collect()
}

/// The option of geometric consistency, followed by a blank.
fn geometric(on: bool) -> String {
    format!("--PatchMatchStereo.geom_consistency {} ", u8::from(on))
}

fn patch_match(selection: &Selection, config: &str, options: &str, scale: MapScale) -> String {
    let size = max_image_size(selection, scale);
    let size = size.map_or(String::new(), |n| {
        format!(" --PatchMatchStereo.max_image_size {n}")
    });
    format!("colmap patch_match_stereo --workspace_path . --config_path {config} {options}{size}")
}

/// Returns the long side of the matched images, if it differs from that of the images.
fn max_image_size(selection: &Selection, scale: MapScale) -> Option<u32> {
    let factor = selection.image_scale * scale.factor();
    (factor < 1.0).then(|| (f64::from(selection.long_side()) * factor).ceil() as u32)
}

/// Returns width and height of an image whose long side is reduced to this, pixels.
fn reduced(size: [u32; 2], long_side: Option<u32>) -> [u32; 2] {
    let long = size[0].max(size[1]);
    let scale = f64::from(long_side.map_or(long, |side| side.min(long))) / f64::from(long.max(1));
    size.map(|side| (f64::from(side) * scale).round() as u32)
}

/// Returns the longest side of the matched images, one number for all of them.
fn size_cap(selection: &Selection) -> u32 {
    (f64::from(selection.long_side()) * selection.image_scale).ceil() as u32
}

/// Adds folders, which patch match does not create: one for each sub-folder of a name, under each
/// kind of map.
fn map_folders<'a>(problems: impl Iterator<Item = &'a Problem>) -> Vec<String> {
    let mut subfolders: Vec<String> = problems
        .map(|p| {
            let path = as_path(&p.reference);
            let folder = path.rsplit_once('/');
            folder.map_or_else(String::new, |(folder, _)| folder.to_owned())
        })
        .collect();
    subfolders.sort_unstable();
    subfolders.dedup();
    let kinds = ["depth_maps", "normal_maps", "consistency_graphs"];
    let folder = |sub: &String| {
        kinds.map(|kind| {
            format!("stereo/{kind}/{sub}")
                .trim_end_matches('/')
                .to_owned()
        })
    };
    subfolders.iter().flat_map(folder).collect()
}

/// Returns a name of a workspace's model, where COLMAP goes by it, as the path that it leads to:
/// without `.` and empty parts.
fn as_path(name: &str) -> String {
    let is_separator = |c: char| c == '/' || cfg!(windows) && c == '\\';
    let parts: Vec<&str> = name
        .split(is_separator)
        .filter(|part| !matches!(*part, "" | "."))
        .collect();
    parts.join("/")
}
