//! Finds the image folder of a project and checks the images in it.

use std::{
    cell::Cell,
    collections::{HashMap, HashSet},
    path::{Component, Path, PathBuf},
};

use rayon::prelude::*;
use viewrank_core::{
    base::median::upper_median,
    model::scene::{Scene, ViewIndex},
};

use super::{
    ImageFolder, MASKS, Project,
    folder::{self, SoughtImages},
    image_files::{images_below, without_masks},
    names::Names,
    probe::{Unread, probe, size_by_header},
};
use crate::{
    formats::{
        exif,
        foreign::{ForeignModel, last_parts},
    },
    mistaken, paths,
};

/// Number of image names that are tried on a candidate for the image folder.
pub(super) const PROBED: usize = 20;

/// Finds the image folder of another program's model by its images.
pub(super) fn find_by_names(
    root: &Path,
    model: &Path,
    foreign: &ForeignModel,
) -> Option<ImageFolder> {
    let named = foreign.image_folder.as_ref().and_then(|folder| {
        let above = model.parent().into_iter().chain([root]);
        above
            .map(|above| above.join(folder))
            .find(|folder| folder.is_dir())
    });
    let names: Vec<String> = foreign
        .model
        .images
        .iter()
        .take(PROBED)
        .map(|image| image.name.to_string())
        .collect();
    let cameras = foreign.model.cameras.iter();
    let sizes = cameras.map(|c| [c.width, c.height]).collect();
    let sought = SoughtImages { names, sizes };
    // The folder of the model alone says nothing.
    folder::find(root, model, named, &sought)
        .filter(|found| found.ends_with("images") || folder::holds_any(found, &sought.names))
}

/// Most names that are looked for in vain: each takes up to a hundred calls of the system, and a
/// small file may name a million. A long name counts as several.
const MOST_MISSING: usize = 10_000;
/// Bytes of a name that count as one.
const USUAL_NAME: usize = 128;

/// Looks for the images of a model in some folders.
pub(super) struct ImageSearch {
    folders: Vec<PathBuf>,
    names: Names,
    missing: Cell<usize>,
}

impl ImageSearch {
    pub fn new(folders: Vec<PathBuf>) -> Self {
        Self {
            folders,
            names: Names::new(),
            missing: Cell::new(0),
        }
    }

    /// Returns the path of the image that is meant by a name, relative to its folder; the name
    /// itself if there is none.
    pub fn spelled(&self, name: &str) -> String {
        let located = || {
            self.folders
                .iter()
                .find_map(|folder| self.names.locate(folder, name))
        };
        self.unless_most_are_missing(name, located)
            .unwrap_or_else(|| name.into())
    }

    /// Returns whether a name means an image.
    pub fn finds(&self, name: &str) -> bool {
        let located = |folder: &PathBuf| self.names.locate(folder, name);
        self.unless_most_are_missing(name, || self.folders.iter().find_map(located))
            .is_some()
    }

    /// Returns width and height by the header of the image, or of that in a folder with the last
    /// parts of its path.
    pub fn size_of(&self, name: &str) -> Option<(u32, u32)> {
        let in_folder = |folder: &PathBuf, name: &str| {
            size_by_header(&folder.join(name)).or_else(|| {
                let file = self.names.locate(folder, name)?;
                size_by_header(&folder.join(file))
            })
        };
        let in_folders = |name: &String| {
            self.folders
                .iter()
                .find_map(|folder| in_folder(folder, name))
        };
        self.unless_most_are_missing(name, || last_parts(name).iter().find_map(in_folders))
    }

    fn unless_most_are_missing<T>(
        &self,
        name: &str,
        look: impl FnOnce() -> Option<T>,
    ) -> Option<T> {
        if self.missing.get() >= MOST_MISSING {
            return None;
        }
        let found = look();
        if found.is_none() {
            let names = 1 + name.len() / USUAL_NAME;
            self.missing.set(self.missing.get() + names);
        }
        found
    }
}

/// Beginnings of warnings.
const MISSING: &str = "images missing from";
const OTHER_SIZE: &str = "images of another size";
const OTHER_ASPECT_RATIO: &str = "images of another aspect ratio";
const UNREADABLE: &str = "images that cannot be read";

/// Why an image has the width of its camera as its height.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Turned {
    /// Its EXIF orientation says that it is to be shown turned, and the model was made from
    /// pictures that were.
    ForDisplay,
    /// A program has turned its pixels, and the model was made from those that were not, or the
    /// reverse.
    InFile,
}

impl Turned {
    /// Says what the file is and what turned it.
    pub fn why(self) -> &'static str {
        match self {
            Self::ForDisplay => {
                "its EXIF orientation says to show it turned by 90°, and the model was made from turned copies"
            }
            Self::InFile => {
                "it was rotated by 90°, as some viewers do on saving; the model's image was not"
            }
        }
    }

    fn of(file: &Path) -> Self {
        if exif::is_shown_turned(file) {
            Self::ForDisplay
        } else {
            Self::InFile
        }
    }

    fn cure(self) -> &'static str {
        match self {
            Self::ForDisplay => {
                "give the turned copies that the model was made from, or turn copies of these as their EXIF says (ImageMagick: mogrify -auto-orient)"
            }
            Self::InFile => {
                "give the images as they were when the model was made, such as from the camera's card, or make the model again from these"
            }
        }
    }
}

/// Faults of the image files of a scene, according to their names and headers.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ImageFaults {
    /// Views without a file.
    pub missing: Vec<ViewIndex>,
    /// Views whose image is a scaled copy of the camera's, with its width and height.
    pub other_size: Vec<(ViewIndex, [u32; 2])>,
    /// Views whose image has another aspect ratio than the camera's, with its width and height.
    pub other_aspect_ratio: Vec<(ViewIndex, [u32; 2])>,
    /// What turned the first of these, if each would fit turned by 90°.
    pub turned: Option<Turned>,
    /// Views whose file is empty, truncated, not an image or not to be read, in words.
    pub unreadable: Vec<(ViewIndex, &'static str)>,
}

impl ImageFaults {
    /// What to do about the images that cannot be read or are other pictures; `None` without such.
    pub fn cure(&self) -> Option<&'static str> {
        match (self.unreadable.first(), self.other_aspect_ratio.first()) {
            (Some((_, why)), _) => {
                Some(mistaken::cure_of(why).unwrap_or("copy them again from the source"))
            }
            (None, Some(_)) => Some(self.turned.map_or(
                "give the images that the model was made from, or the undistorted workspace with its own model",
                Turned::cure,
            )),
            (None, None) => None,
        }
    }

    /// Checks the image files of these views, in parallel.
    pub(super) fn find(folder: &ImageFolder, scene: &Scene, views: &[ViewIndex]) -> Self {
        let check = |view: &ViewIndex| Self::of_view(folder, scene, *view);
        let found: Vec<Self> = views.par_iter().map(check).collect();
        // Where some have another shape than when turned, all may have another reason.
        let of_other_shape = found.iter().filter(|of| !of.other_aspect_ratio.is_empty());
        let turned: Option<Vec<Turned>> = of_other_shape.map(|of| of.turned).collect();
        let mut all = Self {
            turned: turned.and_then(|turned| turned.first().copied()),
            ..Self::default()
        };
        for faults in found {
            all.missing.extend(faults.missing);
            all.other_size.extend(faults.other_size);
            all.other_aspect_ratio.extend(faults.other_aspect_ratio);
            all.unreadable.extend(faults.unreadable);
        }
        all
    }

    fn of_view(folder: &ImageFolder, scene: &Scene, view: ViewIndex) -> Self {
        let camera = scene.camera_of(view);
        let mut faults = Self::default();
        let file = folder.file(scene.name(view));
        match probe(&file) {
            Ok(Some(size)) if !camera.has_aspect_ratio_of(size) => {
                faults.other_aspect_ratio.push((view, size));
                let is_turned = camera.has_aspect_ratio_of([size[1], size[0]]);
                faults.turned = is_turned.then(|| Turned::of(&file));
            }
            Ok(Some(size)) if size != [camera.width, camera.height] => {
                faults.other_size.push((view, size));
            }
            // Formats that cannot be checked are passed over.
            Ok(_) => {}
            Err(Unread::Missing) => faults.missing.push(view),
            Err(Unread::Broken(why)) => faults.unreadable.push((view, why)),
        }
        faults
    }

    /// Pixels of the largest image of a scene that can be read; 0 without one.
    pub fn most_pixels(&self, scene: &Scene) -> u64 {
        let pixels = |[width, height]: [u32; 2]| u64::from(width) * u64::from(height);
        // Larger pictures are refused by their header, so they never take memory.
        let admitted = |view: ViewIndex, pixels: u64| {
            Some(pixels)
                .filter(|&pixels| pixels <= scene.camera_of(view).most_picture_pixels().pixels())
        };
        let without: HashSet<ViewIndex> = self.missing_or_unreadable().collect();
        let others: HashMap<ViewIndex, [u32; 2]> = self
            .other_size
            .iter()
            .chain(&self.other_aspect_ratio)
            .copied()
            .collect();
        let of_view = |view: ViewIndex| {
            let camera = scene.camera_of(view);
            admitted(
                view,
                pixels(
                    others
                        .get(&view)
                        .copied()
                        .unwrap_or([camera.width, camera.height]),
                ),
            )
        };
        scene
            .view_indices()
            .filter(|view| !without.contains(view))
            .filter_map(of_view)
            .max()
            .unwrap_or_default()
    }

    /// Returns the median, over readable images, of the image size over the camera size (the
    /// smaller of the ratios of width and height); `None` without a readable image.
    pub fn usual_scale(&self, scene: &Scene) -> Option<f64> {
        let without: HashSet<ViewIndex> = self.missing_or_unreadable().collect();
        let others: HashMap<ViewIndex, [u32; 2]> = self.other_size.iter().copied().collect();
        let of_view = |view: ViewIndex| {
            let camera = scene.camera_of(view);
            let [width, height] = *others.get(&view).unwrap_or(&[camera.width, camera.height]);
            let of_width = f64::from(width) / f64::from(camera.width);
            of_width.min(f64::from(height) / f64::from(camera.height))
        };
        let readable = scene.view_indices().filter(|view| !without.contains(view));
        // The median, since a few images may have any size.
        upper_median(readable.map(of_view))
    }

    fn missing_or_unreadable(&self) -> impl Iterator<Item = ViewIndex> {
        self.missing
            .iter()
            .copied()
            .chain(self.unreadable.iter().map(|(view, _)| *view))
    }

    /// Views without an image that can be read, ascending; none if that is true of all `views`.
    pub fn without_image(&self, views: usize) -> Vec<ViewIndex> {
        let mut without: Vec<ViewIndex> = self.missing_or_unreadable().collect();
        without.sort_unstable();
        // Without any image, the plan goes by geometry and needs none.
        if self.is_any_readable(views) {
            without
        } else {
            Vec::new()
        }
    }

    /// Views that a plan which compares pictures leaves out, ascending, as far as headers show:
    /// also those whose image has another aspect ratio; none if that is true of all `views`.
    pub fn unusable(&self, views: usize) -> Vec<ViewIndex> {
        let others = self.other_aspect_ratio.iter().map(|(view, _)| *view);
        let mut unusable: Vec<ViewIndex> = self.missing_or_unreadable().chain(others).collect();
        unusable.sort_unstable();
        if unusable.len() < views {
            unusable
        } else {
            Vec::new()
        }
    }

    fn is_any_readable(&self, views: usize) -> bool {
        self.missing_or_unreadable().count() < views
    }

    /// Returns true if at least one of `views` views has an image that can be read and has the
    /// shape of its camera.
    pub fn is_any_usable(&self, views: usize) -> bool {
        self.missing_or_unreadable().count() + self.other_aspect_ratio.len() < views
    }

    /// The faults of these views, which must be ascending.
    pub fn among(&self, views: &[ViewIndex]) -> Self {
        let is_among = |view: &ViewIndex| views.binary_search(view).is_ok();
        let sizes_among = |sizes: &[(ViewIndex, [u32; 2])]| -> Vec<_> {
            sizes
                .iter()
                .copied()
                .filter(|(view, _)| is_among(view))
                .collect()
        };
        Self {
            missing: self.missing.iter().copied().filter(is_among).collect(),
            other_size: sizes_among(&self.other_size),
            turned: self.turned.filter(|_| {
                self.other_aspect_ratio
                    .iter()
                    .any(|(view, _)| is_among(view))
            }),
            other_aspect_ratio: sizes_among(&self.other_aspect_ratio),
            unreadable: self
                .unreadable
                .iter()
                .copied()
                .filter(|(view, _)| is_among(view))
                .collect(),
        }
    }

    /// One warning per kind of fault.
    pub fn warnings(&self, project: &Project, scene: &Scene) -> Vec<String> {
        let Some(folder) = &project.images else {
            return Vec::new();
        };
        let doctor = format!("viewrank doctor {}", project.as_argument());
        let kinds = [
            self.missing_text(folder, scene),
            other_text(OTHER_SIZE, &self.other_size, None, scene),
            other_text(
                OTHER_ASPECT_RATIO,
                &self.other_aspect_ratio,
                self.turned,
                scene,
            ),
            self.unreadable_text(scene),
        ];
        let texts = kinds.into_iter().flatten();
        texts.map(|text| format!("{text}: {doctor}")).collect()
    }

    fn missing_text(&self, folder: &ImageFolder, scene: &Scene) -> Option<String> {
        let name = scene.name(*self.missing.first()?);
        let (count, all) = (self.missing.len(), scene.views.len());
        let two = folder
            .candidates_for(name)
            .map_or_else(String::new, |[one, other]| format!(" ({one} or {other}?)"));
        Some(format!(
            "{MISSING} {}: {count} of {all}, e.g. {name}{two}",
            folder.display()
        ))
    }

    fn unreadable_text(&self, scene: &Scene) -> Option<String> {
        let (first, why) = self.unreadable.first()?;
        let (count, all) = (self.unreadable.len(), scene.views.len());
        let name = scene.name(*first);
        Some(format!(
            "{UNREADABLE}: {count} of {all}, e.g. {name} ({why})"
        ))
    }

    /// Returns whether this is one of [`ImageFaults::warnings`], of whatever views.
    pub fn is_warning(text: &str) -> bool {
        [MISSING, OTHER_SIZE, OTHER_ASPECT_RATIO, UNREADABLE]
            .iter()
            .any(|kind| text.starts_with(kind))
    }
}

/// Text of a warning of images that have other sizes than their cameras.
fn other_text(
    kind: &str,
    views: &[(ViewIndex, [u32; 2])],
    turned: Option<Turned>,
    scene: &Scene,
) -> Option<String> {
    let &(first, [width, height]) = views.first()?;
    let (count, all) = (views.len(), scene.views.len());
    let (camera, name) = (scene.camera_of(first), scene.name(first));
    let model = format!("{} x {}", camera.width, camera.height);
    let why = turned.map_or(String::new(), |turned| format!(" ({})", turned.why()));
    Some(format!(
        "{kind} than their cameras: {count} of {all}, e.g. {name} with {width} x {height} instead of {model}{why}"
    ))
}

/// Images of the folder, other than masks, that the model does not name, sorted; none if the folder
/// has no image of the scene, since a foreign model may name an unrelated folder.
pub(super) fn unregistered(folder: &ImageFolder, scene: &Scene) -> Vec<String> {
    if !scene
        .views
        .iter()
        .take(PROBED)
        .any(|view| folder.file(&view.name).is_file())
    {
        return Vec::new();
    }
    let names = scene
        .views
        .iter()
        .map(|view| &*view.name)
        // The user has taken these out of the model, so they are not left over.
        .chain(scene.left_out.iter().map(String::as_str))
        .chain(folder.other_names().map(|(_, file)| file))
        // Either of them may be the file of a missing image.
        .chain(folder.candidates());
    let registered: HashSet<PathBuf> = names.map(|name| in_folder(name, folder)).collect();
    // A folder of masks may hold photographs, too.
    let is_copy = |part: &str| part != MASKS && folder::holds_no_photographs(part);
    let may_be_one = |path: &Path| {
        let mut folders = path.parent().into_iter().flat_map(Path::components);
        !path.starts_with(MASKS)
            && !folders.any(|part| is_copy(&part.as_os_str().to_string_lossy()))
    };
    let mut photographs = without_masks(images_below(folder, may_be_one));
    photographs.retain(|name| !registered.contains(Path::new(name)));
    photographs
}

/// Tells images of the survey, if the project folder itself is the image folder: those in a folder
/// in it that holds views. What is in the project folder need not belong to the survey.
pub(super) fn is_beside_views(scene: &Scene) -> impl Fn(&String) -> bool {
    let folder = |name: &str| normal(Path::new(name)).parent().map(Path::to_path_buf);
    let of_views = scene.views.iter().filter_map(|view| folder(&view.name));
    let mut of_views: HashSet<PathBuf> = of_views.collect();
    of_views.remove(Path::new(""));
    move |name| folder(name).is_some_and(|folder| of_views.contains(&folder))
}

/// The path in the folder of a file that may be named by a way out of it and back.
fn in_folder(name: &str, folder: &Path) -> PathBuf {
    let name = normal(Path::new(name));
    let is_plain = |part| matches!(part, Component::Normal(_));
    if name.components().all(is_plain) {
        return name;
    }
    let file = paths::place_of_file(&folder.join(&name));
    let inside = file.strip_prefix(paths::real(folder));
    inside.map(Path::to_path_buf).unwrap_or(name)
}

/// Removes `.` components.
fn normal(name: &Path) -> PathBuf {
    name.components()
        .filter(|c| !matches!(c, Component::CurDir))
        .collect()
}

#[cfg(test)]
mod tests {
    use image::ImageFormat;

    use super::*;
    use viewrank_core::{method::synthetic::Town, model::scene::ViewIndex};

    #[test]
    fn in_the_project_folder_images_beside_views_belong_to_the_survey() {
        let mut scene = Town::default().scene();
        scene.views.truncate(2);
        for (view, name) in scene.views.iter_mut().zip(["./images/a.jpg", "b.jpg"]) {
            view.name = name.into();
        }
        let belongs = is_beside_views(&scene);
        let names = ["images/c.jpg", "images/other/d.jpg", "curve.png"];
        assert_eq!(
            names.map(|name| belongs(&name.to_owned())),
            [true, false, false]
        );
    }

    #[test]
    fn images_that_are_missing_broken_or_larger_are_told_apart() {
        let (folder, scene) = (tempfile::tempdir().unwrap(), Town::default().scene());
        let path = |view: u32| {
            let path = folder.path().join(scene.name(ViewIndex(view)));
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            path
        };
        let save = |view, width, height| {
            image::GrayImage::new(width, height)
                .save_with_format(path(view), ImageFormat::Png)
                .unwrap();
        };
        let of = |views: &[ViewIndex]| {
            ImageFaults::find(&ImageFolder::new(folder.path()), &scene, views)
        };
        let all: Vec<ViewIndex> = scene.view_indices().collect();
        let (find, views) = (|| of(&all), all.len());
        assert_eq!(find().missing.len(), views);
        assert_eq!(find().without_image(views), [], "all are elsewhere");
        (0..views as u32).for_each(|view| save(view, 1000, 750));
        assert_eq!(
            (find(), find().most_pixels(&scene)),
            (ImageFaults::default(), 750_000)
        );
        save(5, 1200, 900);
        save(7, 900, 900);
        std::fs::remove_file(path(9)).unwrap();
        std::fs::write(path(3), "").unwrap();
        let faults = find();
        assert_eq!(faults.other_size, [(ViewIndex(5), [1200, 900])]);
        assert_eq!(faults.other_aspect_ratio, [(ViewIndex(7), [900, 900])]);
        assert_eq!(faults.without_image(views), [3, 9].map(ViewIndex));
        assert_eq!(faults.unusable(views), [3, 7, 9].map(ViewIndex));
        let some = [2, 3, 5].map(ViewIndex);
        assert_eq!(of(&some), faults.among(&some), "the others are not opened");
        (0..views as u32).for_each(|view| save(view, 8, 8));
        assert_eq!(
            (find().other_aspect_ratio.len(), find().unusable(views)),
            (views, vec![])
        );
        assert_eq!(faults.most_pixels(&scene), 1_080_000);
    }
}
