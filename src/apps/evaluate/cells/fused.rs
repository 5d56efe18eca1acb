//! Fused clouds whose files name the maps of each point: OpenMVS's PLY with `view_indices`, whose
//! images are those of the `.mvs` beside it, and COLMAP's PLY with the `.vis` beside it, whose
//! images are those of its workspace by ascending id. That of an export has a part of the images.

use std::{
    collections::HashMap,
    fs,
    path::{Path, PathBuf},
};

use nalgebra::Point3;

use super::{CloudPart, FusedPoints, TakePart};
use crate::{
    apps::evaluate::EvaluateError,
    base::{
        error::{Advice, Hint},
        input::{self, FileKind},
    },
    io::{
        depthmaps::DepthMapSet,
        formats::{colmap_bin, openmvs::Mvs},
        ply::{self, PlyError},
    },
    model::scene::{Scene, ViewIndex},
};

/// Folders above a cloud of which one may be the workspace: an export has
/// `stereo/viewrank/fused.ply`.
const LEVELS_TO_WORKSPACE: usize = 3;
/// Points that are handed on together.
const AT_ONCE: usize = 1 << 16;

/// Error in a fused cloud.
#[derive(Debug, thiserror::Error)]
pub enum FusedCloudError {
    #[error("cannot read cloud {}: {source}", path.display())]
    Io {
        path: PathBuf,
        source: std::io::Error,
    },
    #[error("cannot read cloud {}: {source}", path.display())]
    Ply { path: PathBuf, source: PlyError },
    #[error("cannot read {}: {what}", path.display())]
    Views { path: PathBuf, what: String },
}

impl Hint for FusedCloudError {
    fn hint(&self) -> Option<Advice> {
        Some(
            "give the PLY that the program fused, with its .mvs (OpenMVS) or .vis (COLMAP) beside it"
                .into(),
        )
    }

    fn path(&self) -> Option<&Path> {
        match self {
            Self::Io { path, .. } | Self::Ply { path, .. } | Self::Views { path, .. } => Some(path),
        }
    }
}

/// A cloud with the maps of its points.
pub struct FusedCloud {
    path: PathBuf,
    bytes: Vec<u8>,
    views: PointViews,
    /// Map of each image of the program; `None` for one that is not evaluated.
    map_of: Vec<Option<u32>>,
    /// Maps of a point that counts: of fewer that are evaluated, no choice of them gives it.
    support: usize,
}

enum PointViews {
    /// In the cloud itself.
    Listed,
    /// Bytes of COLMAP's `.vis`.
    Beside(Vec<u8>),
}

/// Returns the cloud that names its maps: `asked`, or one at the program's own place that is newer
/// than all maps; `None` without such a cloud.
pub fn find(
    scene: &Scene,
    keys: &[ViewIndex],
    maps: &DepthMapSet,
    support: u32,
    asked: Option<&Path>,
) -> Result<Option<(PathBuf, FusedCloud)>, EvaluateError> {
    if let Some(path) = asked {
        let cloud = FusedCloud::read(path, scene, keys, support)?;
        return Ok(cloud.map(|cloud| (path.to_path_buf(), cloud)));
    }
    for path in usual_places(maps) {
        // Nobody has named this file: where it is not a cloud of these maps, cells come from the
        // maps themselves.
        if is_newer(&path, maps)
            && let Ok(Some(cloud)) = FusedCloud::read(&path, scene, keys, support)
        {
            return Ok(Some((path, cloud)));
        }
    }
    Ok(None)
}

/// `fused.ply` in the folder of the maps (OpenMVS), in that of our COLMAP export, and in COLMAP's
/// workspace.
fn usual_places(maps: &DepthMapSet) -> Vec<PathBuf> {
    let Some(folder) = maps.maps.first().and_then(|map| map.path.parent()) else {
        return Vec::new();
    };
    let workspace = folder.parent().and_then(Path::parent);
    let mut places = vec![folder.join("fused.ply"), folder.join("scene_dense.ply")];
    if let Some(workspace) = workspace {
        let export = ["stereo/viewrank/fused.ply", "fused.ply"];
        places.extend(export.map(|name| workspace.join(name)));
    }
    places
}

fn is_newer(cloud: &Path, maps: &DepthMapSet) -> bool {
    let changed = |path: &Path| fs::metadata(path).and_then(|file| file.modified()).ok();
    let Some(made) = changed(cloud) else {
        return false;
    };
    maps.maps
        .iter()
        .all(|map| changed(&map.path).is_some_and(|changed| changed <= made))
}

impl FusedCloud {
    /// Reads a cloud; `None` if nothing says which maps its points are of.
    fn read(
        path: &Path,
        scene: &Scene,
        keys: &[ViewIndex],
        support: u32,
    ) -> Result<Option<Self>, FusedCloudError> {
        let read = |path: &Path| {
            input::read(path, FileKind::Mesh).map_err(|source| FusedCloudError::Io {
                path: path.into(),
                source,
            })
        };
        let of_view: HashMap<ViewIndex, u32> = keys.iter().copied().zip(0..).collect();
        let map = |view: Option<ViewIndex>| view.and_then(|view| of_view.get(&view).copied());
        let (mvs, vis) = (path.with_extension("mvs"), beside(path));
        let (views, map_of) = if vis.is_file() {
            let map_of = match workspace_images(path)? {
                Some(names) => names.iter().map(|name| map(scene.find(name))).collect(),
                None => {
                    let mut by_id: Vec<ViewIndex> = scene.view_indices().collect();
                    by_id.sort_by_key(|&view| scene.view(view).image_id);
                    by_id.iter().map(|&view| map(Some(view))).collect()
                }
            };
            (PointViews::Beside(read(&vis)?), map_of)
        } else if mvs.is_file() {
            let views = |what: String| FusedCloudError::Views {
                path: mvs.clone(),
                what,
            };
            let images = Mvs::read(&read(&mvs)?)
                .map_err(|fault| views(fault.to_string()))?
                .images;
            let by_id: HashMap<u32, ViewIndex> = scene
                .view_indices()
                .map(|view| (scene.view(view).image_id, view))
                .collect();
            let map_of = images
                .iter()
                .map(|image| map(by_id.get(&image.id).copied()))
                .collect();
            (PointViews::Listed, map_of)
        } else {
            return Ok(None);
        };
        let cloud = Self {
            path: path.into(),
            // Kept, because the cloud is read twice: for its cells, then for their maps.
            bytes: read(path)?,
            views,
            map_of,
            support: support as usize,
        };
        Ok(Some(cloud))
    }

    /// Collects the maps of a point, ascending, each once.
    fn maps(&self, images: &[u32], maps: &mut Vec<u32>) {
        let map = |&image: &u32| self.map_of.get(image as usize).copied().flatten();
        maps.clear();
        maps.extend(images.iter().filter_map(map));
        maps.sort_unstable();
        maps.dedup();
    }
}

impl FusedPoints for FusedCloud {
    fn for_each_part(&self, take: &mut TakePart) -> Result<(), EvaluateError> {
        let (mut part, mut maps, mut taken) = (CloudPart::default(), Vec::new(), Ok(()));
        let mut push = |point: Point3<f64>, images: &[u32]| {
            self.maps(images, &mut maps);
            if maps.len() >= self.support && point.coords.iter().all(|x| x.is_finite()) {
                part.push(point, maps.iter().copied());
            }
            if part.points.len() == AT_ONCE {
                if taken.is_ok() {
                    taken = take(&part);
                }
                // After an error, too: the reader goes on to the end of the file.
                part.clear();
            }
        };
        let ply = |source| FusedCloudError::Ply {
            path: self.path.clone(),
            source,
        };
        match &self.views {
            PointViews::Listed => {
                ply::read_with_lists(&self.bytes, "view_indices", &mut push).map_err(ply)?;
            }
            PointViews::Beside(bytes) => {
                // The lists follow their number, which may be wrong: whether they end with the
                // cloud is checked below.
                let (mut lists, mut images) = (Lists { bytes, at: 8 }, Vec::new());
                ply::read_with_lists(&self.bytes, "", |point, _| {
                    lists.next(&mut images);
                    push(point, &images);
                })
                .map_err(ply)?;
                if lists.at != bytes.len() {
                    return Err(self.other_views().into());
                }
            }
        }
        taken?;
        take(&part)
    }
}

impl FusedCloud {
    fn other_views(&self) -> FusedCloudError {
        FusedCloudError::Views {
            path: beside(&self.path),
            what: "the number of lists of images is not that of the points of the cloud".into(),
        }
    }
}

/// Returns the names of the images of COLMAP's workspace with this cloud, by ascending id; `None`
/// for a cloud in none.
fn workspace_images(cloud: &Path) -> Result<Option<Vec<String>>, FusedCloudError> {
    let above = cloud.ancestors().skip(1).take(LEVELS_TO_WORKSPACE);
    let models = above.map(|folder| folder.join("sparse/images.bin"));
    let Some(path) = models.into_iter().find(|model| model.is_file()) else {
        return Ok(None);
    };
    let bytes = input::open(&path)
        .and_then(|file| input::read_large(&file, FileKind::Sparse))
        .map_err(|source| FusedCloudError::Io {
            path: path.clone(),
            source,
        })?;
    colmap_bin::names_by_id(&bytes)
        .map(Some)
        .map_err(|fault| FusedCloudError::Views {
            path,
            what: fault.to_string(),
        })
}

/// Path of COLMAP's `.vis` of a cloud.
fn beside(cloud: &Path) -> PathBuf {
    let mut path = cloud.as_os_str().to_owned();
    path.push(".vis");
    path.into()
}

/// The lists of a `.vis`: u64 number of points, and for each u32 number of images and u32 indices.
struct Lists<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl Lists<'_> {
    fn number(&mut self) -> Option<u32> {
        let word = self.bytes.get(self.at..)?.get(..4)?;
        self.at += 4;
        Some(u32::from_le_bytes([word[0], word[1], word[2], word[3]]))
    }

    /// Reads the next list. Where the file is too short, the list is empty, and the end is beyond
    /// that of the file.
    fn next(&mut self, images: &mut Vec<u32>) {
        images.clear();
        let Some(count) = self.number() else {
            self.at = usize::MAX;
            return;
        };
        images.extend((0..count).map_while(|_| self.number()));
    }
}
