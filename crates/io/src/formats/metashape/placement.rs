//! Poses of cameras in a chunk, and of a chunk or a component in the world.

use nalgebra::{Matrix3, Vector3};
use viewrank_core::model::georeference::{Geodetic, Georeference};

use crate::formats::{Fault, Problem, colmap::StoredPose, foreign::pose_with_centre, xml::Element};

/// Rotation and centre of a camera, from its axes to the chunk's.
#[derive(Clone)]
pub(super) struct Placement {
    rotation: Matrix3<f64>,
    centre: Vector3<f64>,
}

impl Placement {
    /// Reads a 4 x 4 matrix, row by row.
    pub fn read(transform: &Element) -> Result<Self, Fault> {
        let numbers = transform.numbers::<16>()?;
        let m = |row: usize, column: usize| numbers[4 * row + column];
        Ok(Self {
            rotation: Matrix3::from_fn(m),
            centre: Vector3::from_fn(|row, _| m(row, 3)),
        })
    }

    /// The placement of a slave, whose axes and centre are given in those of this camera.
    pub fn followed_by(self, rotation: Matrix3<f64>, location: Vector3<f64>) -> Self {
        Self {
            centre: self.rotation * location + self.centre,
            rotation: self.rotation * rotation,
        }
    }

    pub fn pose(&self, world: Option<&Similarity>) -> Result<StoredPose, Problem> {
        let (mut rotation, mut centre) = (self.rotation, self.centre);
        if let Some(Similarity {
            rotation: turn,
            translation,
            scale,
        }) = world
        {
            rotation = turn * rotation;
            centre = turn * centre * *scale + translation;
        }
        pose_with_centre(rotation.transpose(), centre)
    }
}

/// Scale, rotation and translation.
pub(super) struct Similarity {
    rotation: Matrix3<f64>,
    translation: Vector3<f64>,
    scale: f64,
}

/// Heights above the ellipsoid of what is surveyed, metres.
const HEIGHTS: std::ops::Range<f64> = -20_000.0..20_000.0;

impl Similarity {
    /// The place on earth of a chunk that this leads from, if it leads to earth-centred
    /// coordinates.
    pub fn place(&self) -> Option<Georeference> {
        // Local coordinates taken for earth-centred would be near the centre of the earth.
        let height = Geodetic::from_ecef(&self.translation).height;
        HEIGHTS.contains(&height).then(|| Georeference::Fitted {
            origin: self.translation,
            axes: self.rotation * self.scale,
            support: None,
        })
    }

    pub fn read(transform: &Element) -> Result<Self, Fault> {
        let rotation = transform
            .child("rotation")
            .map(|rotation| rotation.numbers::<9>())
            .transpose()?;
        let translation = transform
            .child("translation")
            .map(|translation| translation.numbers::<3>())
            .transpose()?;
        Ok(Self {
            rotation: rotation.map_or_else(Matrix3::identity, |rotation| {
                Matrix3::from_row_slice(&rotation)
            }),
            translation: translation.map_or_else(Vector3::zeros, Vector3::from),
            scale: transform.number("scale")?.unwrap_or(1.0),
        })
    }
}
