//! Reads a project's pictures and masks, predicts a confidence map for each view, and caches the maps.

use std::{
    io::ErrorKind,
    path::{Path, PathBuf},
    sync::atomic::{AtomicU64, Ordering},
};

use rayon::prelude::*;

use super::{
    ConfidenceMap, Prediction, Predictor,
    cache::{Cache, Entry, Inputs, Stamp},
    image::{Image, ImageError, Mask, size_for_confidence},
    photometric::{Grey, SPACING},
};
use crate::{
    base::{
        input::{self, FileKind},
        progress::{Cancelled, Stage, Watcher},
    },
    io::project::{ImageFolder, Project},
    model::{
        camera::Camera,
        scene::{Scene, ViewIndex},
    },
};

/// Name of the folder of masks, in the project or next to its image folder.
pub const MASKS: &str = "masks";
/// Path of the map cache, relative to the project.
pub const CACHE: &str = "viewrank/cache/confidence.maps";
/// Number of images named in a warning.
const NAMED: usize = 3;

/// Image and mask folders of a project.
#[derive(Clone, Debug)]
pub struct Pictures {
    images: Option<ImageFolder>,
    /// COLMAP's `mask_path`: `NAME.png` for the image NAME, black where the image may not be used.
    masks: Option<PathBuf>,
    project: PathBuf,
}

/// The predictions for all pictures of a project, with warnings.
#[derive(Clone, Debug, Default)]
pub struct PicturePredictions {
    /// By view; `None` if it has neither image nor mask.
    pub maps: Vec<Option<ConfidenceMap>>,
    /// Median over the images of their dissimilarity to the predictor's training set; `None` without images.
    pub distance: Option<f32>,
    pub warnings: Vec<String>,
    /// New contents of [`CACHE`], if changed.
    pub cache: Option<Vec<u8>>,
}

/// Prediction for one view, or the fault of its picture.
#[derive(Default)]
struct PredictedView {
    entry: Option<Entry>,
    /// The prediction was made now, or its files are newer than the cache says.
    new: bool,
    trouble: Option<ImageError>,
}

impl Pictures {
    pub fn new(project: &Project) -> Self {
        let beside = project.images.as_deref().and_then(Path::parent).map(Path::to_path_buf);
        let masks = [Some(project.root.clone()), beside].into_iter().flatten().map(|folder| folder.join(MASKS));
        Self {
            images: project.images.clone(),
            masks: masks.into_iter().find(|folder| folder.is_dir()),
            project: project.home.clone(),
        }
    }

    pub fn have_images(&self) -> bool {
        self.images.is_some()
    }

    pub(super) fn project(&self) -> &Path {
        &self.project
    }

    /// Returns size and times of a view's image and mask; `None` if the time of change of a file is unknown.
    pub(super) fn stamps(&self, name: &str) -> Option<Inputs> {
        let image = self.images.as_ref().map(|folder| folder.file(name));
        let stamps = Files { image, mask: self.masks.as_deref().and_then(|folder| mask_file(folder, name)) }.inputs();
        stamps.are_dated().then_some(stamps)
    }

    /// Returns the view's picture in grey at half the size at which it is matched, and its mask; `None` without an image folder.
    pub(super) fn grey(
        &self,
        scene: &Scene,
        view: ViewIndex,
        image_scale: f64,
    ) -> Result<Option<(Grey, Option<Mask>)>, ImageError> {
        let Some(folder) = &self.images else { return Ok(None) };
        let (name, camera) = (scene.name(view), scene.camera_of(view));
        let wanted = |[width, height]: [u32; 2]| {
            let scale = image_scale / SPACING * f64::from(camera.width) / f64::from(width);
            [width, height].map(|side| ((f64::from(side) * scale.min(1.0)).round() as u32).max(2))
        };
        let (image, full) = Image::decode_grey(&input::read(&folder.file(name), FileKind::Picture)?, wanted)?;
        check_shape(full, camera)?;
        let mask = self.masks.as_deref().and_then(|folder| mask_file(folder, name));
        let mask = mask.map(|path| Mask::decode(&input::read(&path, FileKind::Picture)?)).transpose()?;
        if let Some(mask) = &mask {
            check_shape([mask.width, mask.height], camera)?;
        }
        Ok(Some((Grey::new(image.width as usize, image.height as usize, image.pixels), mask)))
    }

    /// Returns the paths of a view's image and mask; the image may not exist.
    pub fn files(&self, name: &str) -> [Option<PathBuf>; 2] {
        [
            self.images.as_ref().map(|folder| folder.file(name)),
            self.masks.as_deref().and_then(|folder| mask_file(folder, name)),
        ]
    }

    pub fn have_masks(&self) -> bool {
        self.masks.is_some()
    }

    /// Predicts a map for each view; without a predictor only masks count. Views with a missing or broken image get none, and a warning.
    pub fn predict(
        &self,
        scene: &Scene,
        predictor: Option<&dyn Predictor>,
        watcher: &dyn Watcher,
    ) -> Result<PicturePredictions, Cancelled> {
        let fingerprint = predictor.map_or_else(|| "masks alone".into(), |p| p.fingerprint().to_string());
        let cache = Cache::read(&self.project, CACHE, &fingerprint);
        let views: Vec<ViewIndex> = scene.view_indices().collect();
        let done = AtomicU64::new(0);
        watcher.progress(Stage::Confidence, 0, views.len() as u64);
        let predict = |&view: &ViewIndex| {
            watcher.check()?;
            let predictions = self.predict_view(scene, view, predictor, &cache);
            watcher.progress(Stage::Confidence, 1 + done.fetch_add(1, Ordering::Relaxed), views.len() as u64);
            Ok(predictions)
        };
        let predictions: Vec<PredictedView> = views.par_iter().map(predict).collect::<Result<_, _>>()?;
        let mut all = PicturePredictions {
            warnings: self.warnings(scene, predictor, &predictions),
            ..PicturePredictions::default()
        };
        let changed = predictions.iter().any(|l| l.new);
        let learnt = predictions.iter().filter_map(|l| l.entry.as_ref());
        all.distance = median(learnt.filter(|e| e.inputs.image.is_some()).map(|e| e.predicted.distance).collect());
        all.maps = predictions.iter().map(|l| l.entry.as_ref().map(|entry| entry.predicted.map.clone())).collect();
        if changed {
            let entries = views.iter().zip(predictions);
            let entries = entries.filter_map(|(&view, l)| Some((scene.name(view).to_owned(), l.entry?)));
            all.cache = Some(Cache::new(entries).to_bytes(&fingerprint));
        }
        Ok(all)
    }

    fn predict_view(
        &self,
        scene: &Scene,
        view: ViewIndex,
        predictor: Option<&dyn Predictor>,
        cache: &Cache,
    ) -> PredictedView {
        let name = scene.name(view);
        let [image, mask] = self.files(name);
        let files = Files { image: image.filter(|_| predictor.is_some()), mask };
        // Taken before anything is read: a file that changes meanwhile differs from its stamp and is read again next time.
        let seen = files.inputs();
        if let Some(entry) = cache.untouched(name, &seen) {
            return PredictedView { entry: Some(entry.clone()), ..PredictedView::default() };
        }
        let camera = scene.camera_of(view);
        match files.entry(seen, name, camera, predictor, cache) {
            Ok(entry) => PredictedView { new: entry.is_some(), entry, trouble: None },
            Err(trouble) => {
                let mask_alone = Files { image: None, ..files };
                let mask_alone = mask_alone.entry(mask_alone.inputs(), name, camera, None, cache);
                PredictedView { entry: mask_alone.ok().flatten(), new: false, trouble: Some(trouble) }
            }
        }
    }

    fn warnings(&self, scene: &Scene, predictor: Option<&dyn Predictor>, predictions: &[PredictedView]) -> Vec<String> {
        if predictor.is_some() && self.images.is_none() {
            return vec!["the project has no image folder: no picture was looked at".into()];
        }
        let troubles: Vec<Option<&ImageError>> = predictions.iter().map(|l| l.trouble.as_ref()).collect();
        picture_warnings(scene, &troubles)
    }
}

/// Names the first views whose pictures cannot be used, and counts the rest.
pub fn picture_warnings<E: std::borrow::Borrow<ImageError>>(scene: &Scene, troubles: &[Option<E>]) -> Vec<String> {
    let troubled = || scene.view_indices().zip(troubles).filter_map(|(view, t)| Some((view, t.as_ref()?.borrow())));
    let what = |trouble: &ImageError| match trouble {
        ImageError::Io(error) if error.kind() == ErrorKind::NotFound => "there is no such image".into(),
        other => other.to_string(),
    };
    let named = troubled().take(NAMED);
    let mut warnings: Vec<String> = named
        .map(|(view, trouble)| {
            format!("{}: {}; this view is done without its picture", scene.name(view), what(trouble))
        })
        .collect();
    if let Some(others) = troubled().count().checked_sub(NAMED).filter(|&n| n > 0) {
        warnings.push(format!("{others} more images are missing or broken"));
    }
    warnings
}

/// Image and mask of one view.
struct Files {
    image: Option<PathBuf>,
    mask: Option<PathBuf>,
}

impl Files {
    /// Stamps without hashes of the contents.
    fn inputs(&self) -> Inputs {
        let stamp = |path: &Option<PathBuf>| path.as_deref().and_then(|path| Stamp::read(path).ok());
        Inputs { image: stamp(&self.image), mask: stamp(&self.mask) }
    }

    /// Reads the files, whose stamps were `seen` before, and predicts unless the cache has files with the same contents. `None`: neither image
    /// nor mask.
    fn entry(
        &self,
        seen: Inputs,
        name: &str,
        camera: &Camera,
        predictor: Option<&dyn Predictor>,
        cache: &Cache,
    ) -> Result<Option<Entry>, ImageError> {
        let read =
            |path: &Option<PathBuf>| path.as_deref().map(|path| input::read(path, FileKind::Picture)).transpose();
        let (image, mask) = (read(&self.image)?, read(&self.mask)?);
        let with = |stamp: Option<Stamp>, bytes: &Option<Vec<u8>>| Some(stamp?.with_content(bytes.as_deref()?));
        let inputs = Inputs { image: with(seen.image, &image), mask: with(seen.mask, &mask) };
        if let Some(entry) = cache.same(name, &inputs) {
            return Ok(Some(Entry { inputs, predicted: entry.predicted.clone() }));
        }
        let mask = mask.map(|bytes| Mask::decode(&bytes)).transpose()?;
        let mut predicted = match image.zip(predictor) {
            Some((bytes, predictor)) => {
                let image = Image::decode(&bytes, size_for_confidence)?;
                check_shape(image.full, camera)?;
                Some(predictor.predict(&image))
            }
            None => mask.as_ref().map(|mask| Prediction { map: ConfidenceMap::certain(mask), distance: 0.0 }),
        };
        if let (Some(predicted), Some(mask)) = (&mut predicted, &mask) {
            check_shape([mask.width, mask.height], camera)?;
            predicted.map = predicted.map.masked(mask);
        }
        Ok(predicted.map(|predicted| Entry { inputs, predicted }))
    }
}

/// Reduced copies of the image are accepted; another aspect ratio means another picture.
fn check_shape([width, height]: [u32; 2], camera: &Camera) -> Result<(), ImageError> {
    let ratio = f64::from(width) * f64::from(camera.height) / (f64::from(height) * f64::from(camera.width));
    let rounding = 1.0 / f64::from(width) + 1.0 / f64::from(height);
    let camera = [camera.width, camera.height];
    if (ratio - 1.0).abs() <= rounding { Ok(()) } else { Err(ImageError::Shape { width, height, camera }) }
}

/// `NAME.png`; for a PNG image also its own name. A pipe or a device is found, too, so that reading it says what is wrong.
fn mask_file(folder: &Path, name: &str) -> Option<PathBuf> {
    let own = name.to_ascii_lowercase().ends_with(".png").then(|| folder.join(name));
    [Some(folder.join(format!("{name}.png"))), own].into_iter().flatten().find(|path| path.exists() && !path.is_dir())
}

fn median(mut values: Vec<f32>) -> Option<f32> {
    values.sort_unstable_by(f32::total_cmp);
    values.get(values.len() / 2).copied()
}
