//! Reads the region of the settings (method 5.7).

mod ground;

use std::path::{Path, PathBuf};

pub use ground::{
    GroundSummary, area_in_words, ground_without_surface, photographed_ground, region_in_degrees,
    wanted_gsd,
};

use crate::{
    base::{
        error::{Advice, Hint},
        shell::command_path,
    },
    config::RegionChoice,
    io::{
        paths::from_here,
        region_file::{self, RegionFault, RegionFile},
    },
    method::region::{RegionShape, ShapeError},
    model::georeference::{Georeference, MapFrame},
};

/// The file of a region cannot be used, whatever the surface.
#[derive(Debug, thiserror::Error)]
pub enum RegionFileError {
    #[error("cannot read the region {}: {fault}", from_here(path).display())]
    Read { path: PathBuf, fault: RegionFault },
    #[error("cannot use the {}{}{}: {fault}", before(fault), from_here(path).display(), after(fault))]
    Shape { path: PathBuf, fault: ShapeError },
}

fn before(fault: &ShapeError) -> &'static str {
    match fault {
        ShapeError::Open(_) => "mesh ",
        _ => "region ",
    }
}

fn after(fault: &ShapeError) -> &'static str {
    match fault {
        ShapeError::Open(_) => " as the region",
        _ => "",
    }
}

impl RegionFileError {
    /// The error without anything from a file that it may not quote.
    pub fn quoting(self, may_quote: impl Fn(&Path) -> bool) -> Self {
        match self {
            Self::Read { path, fault } if !may_quote(&path) => Self::Read {
                path,
                fault: fault.hidden(),
            },
            error => error,
        }
    }
}

impl Hint for RegionFileError {
    fn hint(&self) -> Option<Advice> {
        let (path, fault) = match self {
            Self::Read { path, fault } => (path, fault),
            Self::Shape { fault, .. } => return fault.hint(),
        };
        let hint = match fault {
            RegionFault::Mistaken(mistaken) => {
                return Some(mistaken.cure.replace("FILE", &command_path(path)).into());
            }
            RegionFault::Hidden => {
                return Some(
                    Advice::text("name the file with ")
                        .set("region")
                        .and(" yourself to see it"),
                );
            }
            RegionFault::Read(_) => "check that the file exists and is readable",
            RegionFault::Crossing(_) => {
                "put the corners of that ring in order, or split it into polygons"
            }
            RegionFault::Collection(_) => {
                "export polygons as GeoJSON in WGS 84 (EPSG:4326), or in model units with \"crs\": null"
            }
            RegionFault::Value(_) => {
                "correct it there: rings are lists of positions, weight and gsd are numbers"
            }
            _ => "give GeoJSON polygons, a closed PLY mesh, or a box x0,y0,z0,x1,y1,z1",
        };
        Some(hint.into())
    }
}

/// Reads the region. `frame`: the map on which polygons without a georeference are drawn.
pub(super) fn read(
    choice: &RegionChoice,
    place: &Georeference,
    frame: &MapFrame,
) -> Result<RegionShape, RegionFileError> {
    let path = match choice {
        RegionChoice::Auto => return Ok(RegionShape::Auto),
        RegionChoice::Box(corners) => return Ok(RegionShape::of_box(*corners)),
        RegionChoice::File(path) => path,
    };
    let file = region_file::read(path).map_err(|fault| RegionFileError::Read {
        path: path.clone(),
        fault,
    })?;
    let shape = match file {
        RegionFile::Box(corners) => Ok(RegionShape::of_box(corners)),
        RegionFile::Mesh(mesh) => RegionShape::of_mesh(&mesh, frame),
        RegionFile::Areas(areas) => RegionShape::of_areas(areas, place, frame),
    };
    shape.map_err(|fault| RegionFileError::Shape {
        path: path.clone(),
        fault,
    })
}

#[cfg(test)]
mod tests;
