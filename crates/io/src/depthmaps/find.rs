//! Assigns depth map files to views: by name, by number through `view_names.txt`, by the id of the
//! image, or by the name in or beside the file.

use std::{
    borrow::Cow,
    collections::BTreeMap,
    path::{Path, PathBuf},
};

use viewrank_core::model::scene::{Scene, ViewIndex};
use walkdir::WalkDir;

use super::{DepthMapError, DepthMapFormat, micmac, openmvs};
use crate::{
    input::{self, FileKind},
    paths,
    project::{WORKSPACES, is_image},
};

/// COLMAP's folder of depth maps in a dense workspace.
const COLMAP: &str = "stereo/depth_maps";
/// Programs with a depth map folder of their own name: in the project, in viewrank's output folder
/// or in `export`.
const BY_NAME: [&str; 10] = [
    "sgm",
    "openmvs",
    "pairs",
    "mvsnet",
    "patchmatchnet",
    "acmm",
    "gipuma",
    "mve",
    "alicevision",
    "micmac",
];

/// Begin of the names of MicMac's folders, before that of the image without its extension.
const MICMAC_FOLDER: &str = "MM-Malt-Img-";
/// File beside a map that `run.sh` of an export writes when MicMac has finished the map.
pub const MICMAC_MARK: &str = "viewrank.recipe";

/// A finished depth map of a view.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DepthMapFile {
    pub view: ViewIndex,
    pub path: PathBuf,
    pub format: DepthMapFormat,
}

impl DepthMapFile {
    /// Length of the file, bytes; `u64::MAX` for MicMac's, which only names that of the depths.
    pub fn data_bytes(&self) -> u64 {
        match self.format {
            DepthMapFormat::MicMac => u64::MAX,
            _ => std::fs::metadata(&self.path).map_or(0, |found| found.len()),
        }
    }
}

/// The depth maps found under a folder.
#[derive(Debug, Default)]
pub struct DepthMapSet {
    /// One per view, ascending by view.
    pub maps: Vec<DepthMapFile>,
    /// Files with names of depth maps that belong to no view, ascending.
    pub unassigned: Vec<PathBuf>,
    /// Files whose view cannot be determined (damaged, incomplete, or without their list of names),
    /// with the error; ascending.
    pub unreadable: Vec<(PathBuf, DepthMapError)>,
}

impl DepthMapSet {
    /// Fails where no map was found, with the first that cannot be read.
    pub fn not_empty(self, folder: &Path) -> Result<Self, DepthMapError> {
        if !self.maps.is_empty() {
            return Ok(self);
        }
        let unread = self.into_complete().err();
        Err(unread.unwrap_or(DepthMapError::None(folder.into())))
    }

    /// Returns the set if no file is unreadable.
    ///
    /// # Errors
    /// The error of the first unreadable file.
    pub fn into_complete(mut self) -> Result<Self, DepthMapError> {
        if self.unreadable.is_empty() {
            Ok(self)
        } else {
            Err(self.unreadable.swap_remove(0).1)
        }
    }
}

/// Folders in which backends write their depth maps, existing or not: COLMAP's in the project or
/// its dense workspaces ([`WORKSPACES`] and the folders in them), other programs' in a folder of
/// their name.
pub fn default_folders(project: &Path) -> Vec<PathBuf> {
    let mut workspaces = vec![project.to_path_buf()];
    for name in WORKSPACES {
        let workspace = project.join(name);
        workspaces.extend([vec![workspace.clone()], paths::sub_folders(&workspace)].concat());
    }
    workspaces.push(project.join("viewrank/colmap"));
    let mut folders: Vec<PathBuf> = workspaces
        .iter()
        .map(|workspace| workspace.join(COLMAP))
        .collect();
    folders.extend(
        BY_NAME
            .iter()
            .flat_map(|kind| folders_by_name(project, kind)),
    );
    folders.push(project.join("depth_maps"));
    folders
}

/// The existing ones of the [`default_folders`] of a project, without those that a link leads out
/// of it: the project may be a stranger's, and such a folder anything. Users name theirs.
pub fn folders(project: &Path) -> Vec<PathBuf> {
    let mut folders = default_folders(project);
    folders.retain(|folder| folder.is_dir() && !paths::is_outside(folder, project));
    folders
}

/// Map folders of other programs, by name. Whose maps are in `depth_maps` is not known.
pub fn folders_of_others(project: &Path, program: &str) -> Vec<PathBuf> {
    let is_own = |folder: &PathBuf| {
        folder.ends_with(program)
            || program == "colmap" && folder.ends_with(COLMAP)
            || *folder == project.join("depth_maps")
    };
    let mut folders = folders(project);
    folders.retain(|folder| !is_own(folder));
    folders
}

fn folders_by_name(project: &Path, kind: &str) -> [PathBuf; 3] {
    [
        project.join(kind),
        project.join("viewrank").join(kind),
        project.join("export").join(kind),
    ]
}

/// Depth map folder of a program in a project (`dense`: its dense workspace): the first of the
/// [`folders`], or the first candidate in the project; `None` where links lead all out of it. Any
/// other `kind` is a folder in the project.
pub fn folder_of(project: &Path, dense: Option<&Path>, kind: &str) -> Option<PathBuf> {
    let mut candidates: Vec<PathBuf> = match kind {
        "colmap" => {
            let own = project.join("viewrank/colmap");
            let workspaces = dense.into_iter().chain([&*own]);
            workspaces.map(|folder| folder.join(COLMAP)).collect()
        }
        kind if BY_NAME.contains(&kind) => folders_by_name(project, kind).into(),
        other => vec![project.join(other)],
    };
    candidates.retain(|folder| !paths::is_outside(folder, project));
    // The folder of its name may be its export, which holds no maps.
    let is_there = |folder: &&PathBuf| match kind {
        "sgm" => folder.join("depth_maps").is_dir(),
        _ => folder.is_dir(),
    };
    let there = candidates.iter().find(is_there);
    there.or(candidates.first()).cloned()
}

/// Finds the depth maps under `folder` as [`list`] does.
///
/// # Errors
/// As [`list`]; without any map, the error of the first unreadable file or [`DepthMapError::None`].
pub fn find(folder: &Path, scene: &Scene) -> Result<DepthMapSet, DepthMapError> {
    list(folder, scene)?.not_empty(folder)
}

/// Lists the depth maps under `folder`. A geometric map replaces the photometric map of the same
/// view (COLMAP, ACMM).
///
/// # Errors
/// If the folder cannot be listed, or a view has two maps.
pub fn list(folder: &Path, scene: &Scene) -> Result<DepthMapSet, DepthMapError> {
    list_preferring(folder, scene, &|_| true)
}

/// As [`list`], but of the maps of a view one that is preferred comes first, such as that of a
/// plan.
///
/// # Errors
/// As [`list`].
pub fn list_preferring(
    folder: &Path,
    scene: &Scene,
    is_preferred: &dyn Fn(&Path) -> bool,
) -> Result<DepthMapSet, DepthMapError> {
    let mut best: BTreeMap<ViewIndex, ((bool, u8), PathBuf, DepthMapFormat)> = BTreeMap::new();
    let (mut unassigned, mut unreadable) = (Vec::new(), Vec::new());
    let mut numbers = Numbers {
        folder,
        scene,
        views: None,
    };
    // Sorted: which of two maps of a view is named first must not depend on the file system.
    for entry in WalkDir::new(folder).sort_by_file_name() {
        let entry = match entry {
            // Only the folder itself must be there.
            Err(error) if error.depth() > 0 && error.io_error().is_some_and(is_gone) => continue,
            entry => entry
                .map_err(input::cause)
                .map_err(DepthMapError::io(folder))?,
        };
        let path = entry.path();
        let inside = path.strip_prefix(folder).unwrap_or(path);
        // Asked only of names of maps: a system call for each file of a workspace would take long.
        let is_map = |_: &_| path.is_file() && !is_copy(path);
        let Some((format, rank)) = format_of(inside).filter(is_map) else {
            continue;
        };
        let view = match view_of(path, format, &mut numbers) {
            Ok(Some(view)) => view,
            Ok(None) => {
                unassigned.push(path.to_path_buf());
                continue;
            }
            Err(error) => {
                unreadable.push((path.to_path_buf(), error));
                continue;
            }
        };
        // False is less than true, so that a preferred map comes first.
        let rank = (!is_preferred(path), rank);
        let found = (rank, path.to_path_buf(), format);
        match best.get_mut(&view) {
            None => drop(best.insert(view, found)),
            Some(kept) if kept.0 == rank => return Err(duplicate(scene, view, &kept.1, path)),
            Some(kept) if kept.0 > rank => *kept = found,
            Some(_) => {}
        }
    }
    let maps = best
        .into_iter()
        .map(|(view, (_, path, format))| DepthMapFile { view, path, format })
        .collect();
    Ok(DepthMapSet {
        maps,
        unassigned,
        unreadable,
    })
}

/// Returns whether the file was removed while its folder was being listed, as backends do.
fn is_gone(error: &std::io::Error) -> bool {
    error.kind() == std::io::ErrorKind::NotFound
}

fn duplicate(scene: &Scene, view: ViewIndex, first: &Path, second: &Path) -> DepthMapError {
    DepthMapError::Duplicate {
        view: scene.name(view).into(),
        first: first.into(),
        second: second.into(),
    }
}

/// Returns whether a file has the name of a depth map, or of what a program writes with one:
/// confidences, MicMac's images, marks of what is finished.
pub fn is_of_a_map(path: &Path) -> bool {
    let in_folder = |is_it: fn(&str) -> bool| {
        path.parent()
            .and_then(Path::file_name)
            .and_then(|name| name.to_str())
            .is_some_and(is_it)
    };
    let has = |extension: &str| path.extension().is_some_and(|e| e == extension);
    format_of(path).is_some()
        || has("pfm") && in_folder(|name| name == "confidence")
        || has("tif") && in_folder(|name| name.starts_with(MICMAC_FOLDER))
        || path.file_name().is_some_and(|name| name == MICMAC_MARK)
}

/// Returns the files that say whether the depth map at this path below `folder` has changed, itself
/// first; none if it doesn't have the name of a depth map. Some may not be there.
pub fn files_of(folder: &Path, path: &Path) -> Vec<PathBuf> {
    let Some((format, _)) = format_of(path.strip_prefix(folder).unwrap_or(path)) else {
        return Vec::new();
    };
    let itself = std::iter::once(path.to_path_buf());
    match format {
        DepthMapFormat::MicMac => match micmac_mark(path) {
            // The mark is written last, so it changes with the images.
            Some(mark) => itself.chain([mark]).collect(),
            None => itself
                .chain(micmac_images(path).into_iter().flatten())
                .collect(),
        },
        DepthMapFormat::Pfm => itself.chain(super::confidences_of(path)).collect(),
        _ => itself.collect(),
    }
}

/// Returns the files that hold the depths of a map, by which it is known again.
pub fn files_with_depths(map: &DepthMapFile) -> Vec<PathBuf> {
    let images = (map.format == DepthMapFormat::MicMac)
        .then(|| micmac_images(&map.path).ok())
        .flatten();
    std::iter::once(map.path.clone())
        .chain(images.map(|[depths, _]| depths))
        .collect()
}

/// Determines the format from the path below the folder, and the rank among maps of the same view
/// (0 is best).
fn format_of(path: &Path) -> Option<(DepthMapFormat, u8)> {
    let name = path.file_name()?.to_str()?;
    let in_folder = |word: &str| {
        path.parent()
            .is_some_and(|p| p.components().any(|c| c.as_os_str() == word))
    };
    let is_other_map =
        in_folder("normal_maps") || in_folder("consistency_graphs") || in_folder("counts");
    // Where the `run.sh` of an export keeps the maps of other plans, and those that are not
    // finished.
    let is_set_aside = in_folder("older") || in_folder("kept") || in_folder("unfinished");
    match name {
        _ if is_other_map => None,
        _ if name.ends_with(".geometric.bin") => Some((DepthMapFormat::ColmapGeometric, 0)),
        _ if name.ends_with(".photometric.bin") && !is_in_colmaps_task(path) => {
            Some((DepthMapFormat::ColmapPhotometric, 1))
        }
        _ if is_dmap(name) && !is_unfinished(path) => Some((DepthMapFormat::OpenMvs, 0)),
        "depths_geom.dmb" => Some((DepthMapFormat::Dmb, 0)),
        "depths.dmb" => Some((DepthMapFormat::Dmb, 1)),
        "disp.dmb" if !is_set_aside => Some((DepthMapFormat::Gipuma, 0)),
        // Filtered maps come before those that they were made from.
        _ if name.ends_with("_depthMap.exr") && !is_set_aside => Some((
            DepthMapFormat::AliceVision,
            u8::from(!(in_folder("filtered") || in_folder("DepthMapFilter"))),
        )),
        _ if name.ends_with(".mvei") && !is_set_aside => {
            Some((DepthMapFormat::Mve, mve_scale(name)?))
        }
        "MMLastNuage.xml" if !is_set_aside => Some((DepthMapFormat::MicMac, 0)),
        _ if name.ends_with("_prob.pfm") || in_folder("confidence") => None,
        _ if name.ends_with(".pfm") && !is_copy(path) && !is_set_aside => {
            Some((DepthMapFormat::Pfm, 0))
        }
        _ if name.ends_with(".npy") => Some((DepthMapFormat::Npy, 0)),
        _ => None,
    }
}

/// Returns whether a script of exports until November 2026 has made the map for the fusion, with
/// those of half the size enlarged.
fn is_copy(map: &Path) -> bool {
    paths::absolute(map)
        .parent()
        .is_some_and(|folder| folder.ends_with("fuse/depth_est"))
}

/// The scale of `depth-L2.mvei`: images halved twice. MVE keeps confidences (`conf-L2.mvei`) and
/// images beside it.
fn mve_scale(name: &str) -> Option<u8> {
    name.strip_prefix("depth-L")?
        .strip_suffix(".mvei")?
        .parse()
        .ok()
}

/// Returns whether a task is still writing or fusing the map (`unfinished/NAME/depth0012.dmap`).
fn is_unfinished(path: &Path) -> bool {
    let above = path.ancestors().nth(2).and_then(Path::file_name);
    above.is_some_and(|name| name == "unfinished")
}

/// Returns whether a task is still making the map, in a workspace of its own.
fn is_in_colmaps_task(path: &Path) -> bool {
    path.ancestors()
        .any(|above| above.ends_with("stereo/viewrank/unfinished"))
}

/// Accepts `depth0012.dmap`, but not OpenMVS's intermediate `depth0012.geo.dmap` and
/// `depth0012.filtered.dmap`.
fn is_dmap(name: &str) -> bool {
    let digits = name
        .strip_prefix("depth")
        .and_then(|n| n.strip_suffix(".dmap"));
    digits.is_some_and(|d| !d.is_empty() && d.bytes().all(|b| b.is_ascii_digit()))
}

/// Name of the folder that a map is in.
fn folder_name(path: &Path) -> Cow<'_, str> {
    let folder = path.parent().and_then(Path::file_name);
    folder.unwrap_or_default().to_string_lossy()
}

fn view_of(
    path: &Path,
    format: DepthMapFormat,
    numbers: &mut Numbers,
) -> Result<Option<ViewIndex>, DepthMapError> {
    let text = path.to_string_lossy().replace('\\', "/");
    let scene = numbers.scene;
    Ok(match format {
        DepthMapFormat::ColmapGeometric => by_suffix(scene, &text, ".geometric.bin"),
        DepthMapFormat::ColmapPhotometric => by_suffix(scene, &text, ".photometric.bin"),
        DepthMapFormat::Npy => by_suffix(scene, &text, ".npy"),
        DepthMapFormat::OpenMvs => {
            let image = dmap_image(path)?;
            by_suffix(scene, &image, "").or_else(|| by_suffix_of_any_kind(scene, &image))
        }
        DepthMapFormat::Pfm => match by_suffix(scene, &text, ".pfm") {
            Some(view) => Some(view),
            None => numbers.view(path.file_stem().and_then(|s| s.to_str()))?,
        },
        DepthMapFormat::Dmb => numbers.view(Some(folder_name(path).trim_start_matches("2333_")))?,
        // 2, date, time, and the name of the image without its extension, which may have `_`
        // itself; 2, hash and number in an export.
        DepthMapFormat::Gipuma => match folder_name(path).splitn(4, '_').collect::<Vec<_>>()[..] {
            [_, _, _, stem] => by_stem(scene, stem),
            [.., number] => numbers.view(Some(number))?,
            [] => None,
        },
        DepthMapFormat::Mve => {
            let name = mve_name(path)?;
            name.and_then(|name| scene.find(&name).or_else(|| by_stem(scene, &name)))
        }
        DepthMapFormat::MicMac => {
            let view = folder_name(path)
                .strip_prefix(MICMAC_FOLDER)
                .and_then(|stem| by_stem(scene, stem));
            view.map(|view| require_matched(path).map(|()| view))
                .transpose()?
        }
        DepthMapFormat::AliceVision => {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            let id = name.trim_end_matches("_depthMap.exr").parse::<u32>().ok();
            let is_it = |&i: &u32| Some(scene.view(ViewIndex(i)).image_id) == id;
            (0..scene.views.len() as u32).find(is_it).map(ViewIndex)
        }
    })
}

/// Checks that MicMac has matched a view: the cloud is described before that, and its depth image
/// rewritten at the end.
fn require_matched(path: &Path) -> Result<(), DepthMapError> {
    let needed = micmac_images(path)?.into_iter().chain(micmac_mark(path));
    let missing = needed
        .filter(|file| !file.is_file())
        .map(|file| DepthMapError::Unmatched {
            path: path.into(),
            file,
        });
    missing.take(1).try_for_each(Err)
}

/// Returns the depth image and the mask that a description of MicMac names.
fn micmac_images(path: &Path) -> Result<[PathBuf; 2], DepthMapError> {
    let bytes = input::read(path, FileKind::Settings).map_err(DepthMapError::io(path))?;
    Ok(micmac::files(&bytes)
        .map_err(DepthMapError::format(path))?
        .map(|name| path.with_file_name(name)))
}

/// Returns the mark that `run.sh` of an export sets when MicMac has finished a view; `None`
/// elsewhere.
fn micmac_mark(path: &Path) -> Option<PathBuf> {
    let is_export = path
        .ancestors()
        .nth(2)
        .is_some_and(|folder| folder.join("ImSec").is_dir());
    is_export.then(|| path.with_file_name(MICMAC_MARK))
}

/// The name in the `meta.ini` beside a map of MVE: that of the image, or its stem. `None` without
/// that file: a later export has no such view.
fn mve_name(path: &Path) -> Result<Option<String>, DepthMapError> {
    let meta = path.with_file_name("meta.ini");
    let text = match input::read_text(&meta, FileKind::List) {
        Ok(text) => text,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(DepthMapError::io(&meta)(error)),
    };
    let values = text.lines().filter_map(|line| line.split_once('='));
    let name = values
        .filter(|(key, _)| key.trim() == "name")
        .map(|(_, name)| name.trim().to_string())
        .next();
    name.map(Some).ok_or_else(|| DepthMapError::Names {
        path: meta,
        what: "no name of the view".into(),
    })
}

/// The only view whose file name without extension this is.
fn by_stem(scene: &Scene, stem: &str) -> Option<ViewIndex> {
    let stem_of =
        |view: &ViewIndex| Path::new(scene.name(*view)).file_stem() == Some(stem.as_ref());
    let mut views = (0..scene.views.len() as u32).map(ViewIndex).filter(stem_of);
    views.next().filter(|_| views.next().is_none())
}

/// Finds the view whose name is the longest suffix of the path without its extension.
fn by_suffix(scene: &Scene, path: &str, extension: &str) -> Option<ViewIndex> {
    let path = path.strip_suffix(extension)?;
    let mut starts = std::iter::once(0).chain(path.match_indices('/').map(|(i, _)| i + 1));
    starts.find_map(|start| scene.find(&path[start..]))
}

/// As [`by_suffix`], for an image whose file has another extension than its name in the model, or
/// one more; `None` if several views may be meant.
fn by_suffix_of_any_kind(scene: &Scene, path: &str) -> Option<ViewIndex> {
    // What follows a dot may also be a part of the name.
    fn stem(name: &str) -> &str {
        if is_image(Path::new(name)) {
            paths::stem(name)
        } else {
            name
        }
    }
    let path = stem(path);
    let length = |view: &ViewIndex| {
        let rest = path.strip_suffix(stem(scene.name(*view)))?;
        (rest.is_empty() || rest.ends_with('/')).then_some(path.len() - rest.len())
    };
    let longest = scene
        .view_indices()
        .filter_map(|view| length(&view))
        .max()?;
    let mut views = scene
        .view_indices()
        .filter(|view| length(view) == Some(longest));
    views.next().filter(|_| views.next().is_none())
}

/// Returns the ids of the key view and its partners that OpenMVS's map names.
///
/// # Errors
/// If the file cannot be read or is no such map.
pub fn ids_of(map: &Path) -> Result<Vec<u32>, DepthMapError> {
    openmvs::read_header(map).map(|header| header.ids)
}

fn dmap_image(path: &Path) -> Result<String, DepthMapError> {
    openmvs::read_header(path).map(|header| header.image.replace('\\', "/"))
}

/// The numbers of `view_names.txt`, read at the first numbered map.
struct Numbers<'a> {
    folder: &'a Path,
    scene: &'a Scene,
    views: Option<BTreeMap<u64, ViewIndex>>,
}

impl Numbers<'_> {
    /// Finds the view of a number such as `00000012` or `00000012_init`.
    fn view(&mut self, stem: Option<&str>) -> Result<Option<ViewIndex>, DepthMapError> {
        let digits: String = stem
            .unwrap_or("")
            .chars()
            .take_while(char::is_ascii_digit)
            .collect();
        let Ok(number) = digits.parse::<u64>() else {
            return Ok(None);
        };
        if self.views.is_none() {
            self.views = Some(read_view_names(self.folder, self.scene)?);
        }
        Ok(self
            .views
            .as_ref()
            .and_then(|views| views.get(&number).copied()))
    }
}

/// Reads `view_names.txt` in the folder or in one of the three above it: lines of number, tab,
/// name.
fn read_view_names(
    folder: &Path,
    scene: &Scene,
) -> Result<BTreeMap<u64, ViewIndex>, DepthMapError> {
    let path = folder
        .ancestors()
        .take(4)
        .map(|f| f.join("view_names.txt"))
        .find(|p| p.is_file());
    let path = path.ok_or_else(|| DepthMapError::Names {
        path: folder.into(),
        what: "numbered depth maps need a view_names.txt, which is missing here and in the three folders above".into(),
    })?;
    let text = input::read_text(&path, FileKind::List).map_err(DepthMapError::io(&path))?;
    let mut views = BTreeMap::new();
    for (line, content) in text
        .lines()
        .enumerate()
        .filter(|(_, l)| !l.is_empty() && !l.starts_with('#'))
    {
        // Gipuma's list has the file names of the export: `00000012.jpg`.
        let number = |text: &str| text.trim().trim_end_matches(".jpg").parse().ok();
        let entry = content
            .split_once('\t')
            .and_then(|(n, name)| Some((number(n)?, name)));
        let (number, name) = entry.ok_or_else(|| DepthMapError::Names {
            path: path.clone(),
            what: format!(
                "line {}: expected a number, a tab and an image name",
                line + 1
            ),
        })?;
        // The list may be that of an earlier export, with images that the scene lacks.
        if let Some(view) = scene.find(name) {
            views.insert(number, view);
        }
    }
    Ok(views)
}
