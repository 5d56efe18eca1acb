//! The trained confidence and its file (method 7.3).
//!
//! The file is JSON: one object with all that a prediction needs and its origin. It is validated before use:
//! whatever it contains, predicting neither fails nor takes more memory than the size of the file suggests.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::{
    ConfidenceMap, Prediction, Predictor, Unary,
    curves::{self, PairCurves, PlaceCurves},
    features::{self, Features},
    image::Image,
    place::{self, PlaceFeatures},
    trees::{BINS, Classifier, logistic},
};
use crate::{
    base::{
        column::{self, ColumnBuilder, TableError},
        error::Hint,
        input::{self, FileKind},
        progress::Watcher,
    },
    method::geometry::Geometry,
    model::scene::{ViewIndex, ViewPoints},
};

/// Version of the file format; a program reads only its own version.
pub const VERSION: u32 = 2;
/// Value of `format`, which identifies the file type.
const FORMAT: &str = "viewrank confidence model";
/// The model that comes with the program.
const SHIPPED: &[u8] = include_bytes!("shipped.model");

/// A trained confidence, with its origin.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TrainedModel {
    pub format: String,
    pub version: u32,
    /// Program that wrote the file.
    pub tool: String,
    pub licence: String,
    /// Name of the backend whose depth maps it was trained on.
    pub backend: String,
    pub trained_on: Vec<TrainedOn>,
    pub seed: u64,
    pub measured: ValidationScores,
    pub pair: PairCurves,
    pub place: PlaceCurves,
    /// `None` if trained without pictures.
    pub picture: Option<PictureModel>,
}

/// A training project.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct TrainedOn {
    /// Name of the project's folder.
    pub name: String,
    /// Number of views of its model.
    pub views: usize,
    /// Number of finished depth maps used for training.
    pub depth_maps: usize,
}

/// Out-of-sample scores: on views, or with several projects on projects, left out of the training.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ValidationScores {
    /// Judged triangles of finished clusters: their number, the area under the ROC curve, mean squared error, and mean distance between predicted
    /// and observed shares over ten equal ranges of prediction, weighted by the triangles in each.
    pub triangles: usize,
    pub auc: f64,
    pub brier: f64,
    pub calibration_error: f64,
    /// The same for single pixels, predicted from the picture alone.
    pub pixels: usize,
    pub pixel_auc: f64,
    pub pixel_brier: f64,
}

/// Picture part of the model.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PictureModel {
    pub classifier: Classifier,
    /// Platt scaling: log odds are multiplied by the first and shifted by the second.
    pub calibration: [f32; 2],
    /// By feature, then bin: cumulative share of the training cells.
    pub cumulative: Vec<Vec<f32>>,
    /// 95th percentile of the distances between a training image and all of them.
    pub reach: f32,
}

impl TrainedModel {
    /// Returns `None` if the program was built without one.
    pub fn shipped() -> Option<Self> {
        Self::parse(SHIPPED, Path::new("shipped.model")).ok()
    }

    pub fn read(path: &Path) -> Result<Self, TrainedError> {
        let bytes =
            input::read(path, FileKind::Trained).map_err(|source| TrainedError::Io { path: path.into(), source })?;
        Self::parse(&bytes, path)
    }

    /// Parses and checks the contents of the file at `path`.
    pub fn parse(bytes: &[u8], path: &Path) -> Result<Self, TrainedError> {
        #[derive(Deserialize)]
        struct Head {
            format: String,
            version: u32,
        }
        let broken = |what: String| TrainedError::Format { path: path.into(), what };
        let head: Head = serde_json::from_slice(bytes).map_err(|e| broken(format!("not a model: {e}")))?;
        if head.format != FORMAT {
            return Err(broken(format!("it says that it is a {:?}", head.format)));
        }
        if head.version != VERSION {
            return Err(TrainedError::Version { path: path.into(), version: head.version });
        }
        let trained: Self = serde_json::from_slice(bytes).map_err(|e| broken(e.to_string()))?;
        let sound =
            trained.pair.is_sound() && trained.place.is_sound() && trained.picture.iter().all(PictureModel::is_sound);
        if sound { Ok(trained) } else { Err(broken("its numbers make no sense".into())) }
    }

    /// Returns the contents of a model file.
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut bytes = serde_json::to_vec(self).expect("text and finite numbers are JSON");
        bytes.push(b'\n');
        bytes
    }

    pub fn head() -> (String, String, String) {
        let tool = concat!("viewrank ", env!("CARGO_PKG_VERSION"));
        (
            FORMAT.into(),
            tool.into(),
            "the licence of the images that it was trained on does not reach its numbers".into(),
        )
    }

    /// Returns a hexadecimal fingerprint of the model.
    pub fn fingerprint(&self) -> String {
        blake3::hash(&self.to_bytes()).to_string()
    }

    /// Predicts each row of the visibility table, as the key view's and as a partner's. `maps`: predictions of [`PictureModel`] for each view.
    pub fn unary(
        &self,
        geometry: &Geometry,
        points: &ViewPoints,
        maps: &[Option<ConfidenceMap>],
        watcher: &dyn Watcher,
    ) -> Result<Unary, TableError> {
        let promised = Unary::new(geometry.scene, geometry.surface, geometry.visibility, maps, watcher)?;
        let places = PlaceFeatures::new(*geometry, points, watcher)?;
        let of_view = |_: &mut (), &view: &ViewIndex| {
            watcher.check()?;
            let of_row = |row: usize| {
                let promise = if maps[view.index()].is_some() { promised.confidence(row) } else { f32::NAN };
                let numbers = places.numbers(view, row, promise);
                let key = logistic(self.place.bias + curves::sum(&self.place.key, &numbers));
                (key, curves::sum(&self.place.partner, &numbers))
            };
            Ok(geometry.visibility.rows(view).map(of_row).collect::<Vec<_>>())
        };
        let views: Vec<ViewIndex> = geometry.scene.view_indices().collect();
        let keep = geometry.visibility.triangles.storage();
        let (mut values, mut partner_odds) = (ColumnBuilder::new(keep)?, ColumnBuilder::new(keep)?);
        column::in_order(
            &views,
            column::READ_AT_ONCE,
            || (),
            of_view,
            |_, rows: Vec<Vec<(f32, f32)>>| {
                geometry.visibility.triangles.release();
                promised.release();
                places.release();
                let (keys, partners): (Vec<f32>, Vec<f32>) = rows.into_iter().flatten().unzip();
                values.extend(&keys)?;
                partner_odds.extend(&partners)
            },
        )?;
        Ok(Unary { values: values.finish()?, partner_odds: partner_odds.finish()? })
    }
}

impl PictureModel {
    fn is_sound(&self) -> bool {
        let shares = |bins: &Vec<f32>| bins.len() == BINS && bins.iter().all(|s| s.is_finite());
        self.classifier.is_sound()
            && self.classifier.binning.features() == features::COUNT
            && self.cumulative.len() == features::COUNT
            && self.cumulative.iter().all(shares)
            && self.calibration.iter().all(|c| c.is_finite())
            && self.reach.is_finite()
            && self.reach > 0.0
    }

    /// Returns the calibrated probability of each cell, and the distance of the picture from the training cells relative to `reach`.
    pub fn of_cells(&self, features: &Features) -> (Vec<f32>, f32) {
        let mut bins = vec![0u8; features::COUNT];
        let mut counts = vec![[0u32; BINS]; features::COUNT];
        let mut of_cell = |cell: usize| {
            self.classifier.binning.quantise(features.cell(cell), &mut bins);
            bins.iter().zip(&mut counts).for_each(|(&bin, counts)| counts[usize::from(bin)] += 1);
            self.calibrated(self.classifier.probability_of_bins(&bins))
        };
        let chances = (0..features.cells()).map(&mut of_cell).collect();
        (chances, self.apart(&counts, features.cells()))
    }

    pub fn calibrated(&self, chance: f32) -> f32 {
        logistic(self.calibration[0] * place::odds_of(chance) + self.calibration[1])
    }

    /// Returns the mean over the features of the Kolmogorov-Smirnov distance.
    fn apart(&self, counts: &[[u32; BINS]], cells: usize) -> f32 {
        let of_feature = |(counts, known): (&[u32; BINS], &Vec<f32>)| {
            let mut sum = 0;
            let differences = counts.iter().zip(known).map(|(&count, &known)| {
                sum += count;
                (sum as f32 / cells as f32 - known).abs()
            });
            differences.fold(0.0, f32::max)
        };
        counts.iter().zip(&self.cumulative).map(of_feature).sum::<f32>() / self.cumulative.len() as f32
    }
}

impl Predictor for PictureModel {
    fn fingerprint(&self) -> blake3::Hash {
        blake3::hash(&serde_json::to_vec(self).expect("finite numbers are JSON"))
    }

    fn predict(&self, image: &Image) -> Prediction {
        let features = Features::new(image);
        let (chances, apart) = self.of_cells(&features);
        let map = ConfidenceMap::new([features.columns, features.rows], chances.into_iter());
        Prediction { map, distance: apart / self.reach }
    }
}

/// A model that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum TrainedError {
    #[error("{}: {source}", path.display())]
    Io { path: PathBuf, source: std::io::Error },
    #[error("{}: {what}", path.display())]
    Format { path: PathBuf, what: String },
    #[error("no trained model comes with this program")]
    NotShipped,
    #[error("{}: a model of version {version}, this program reads version {VERSION}", path.display())]
    Version { path: PathBuf, version: u32 },
}

impl Hint for TrainedError {
    fn hint(&self) -> Option<String> {
        Some(match self {
            Self::Io { .. } | Self::NotShipped => {
                "give none, geometric, photometric, proxy, shipped, auto, or a model file that viewrank train has written".into()
            }
            Self::Format { .. } => "train the model again with viewrank train".into(),
            Self::Version { version, .. } if *version > VERSION => {
                "take the viewrank that wrote it, or a newer one; or train again with this one".into()
            }
            Self::Version { .. } => "train the model again with this viewrank".into(),
        })
    }

    fn is_usage(&self) -> bool {
        match self {
            Self::NotShipped => true,
            Self::Io { source, .. } => source.kind() == std::io::ErrorKind::NotFound,
            Self::Format { .. } | Self::Version { .. } => false,
        }
    }
}
