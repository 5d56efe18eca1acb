//! Polygons projected onto a surface as on a map, at all heights.

use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

use super::{
    GroundPlane, Outline, RegionError, RegionProperties, ShapeError, TriangleSamples,
    columns::{Columns, Rectangle},
    in_parts,
    polygon::{PreparedPolygon, polygon_area},
    sampled,
};
use crate::{
    base::progress::Watcher,
    model::{
        georeference::{Georeference, MapFrame},
        surface::Surface,
    },
};

/// Tolerance of the length of a unit vector.
const UNIT: f64 = 1e-3;

/// Polygons on a map, in the order of the file: where some overlap, the last one holds.
#[derive(Clone, Debug, PartialEq)]
pub struct Areas {
    pub coordinates: Coordinates,
    pub areas: Vec<Area>,
}

/// Coordinate system of polygons.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Coordinates {
    /// Not said: longitude and latitude, unless the model has no georeference.
    Unsaid,
    /// WGS 84: longitude and latitude, degrees.
    Geodetic,
    /// Scene units along the first two `axes` (unit vectors, world coordinates),
    /// without them those of the map.
    Model { axes: Option<[[f64; 3]; 3]> },
}

/// Polygons of a feature and their properties.
#[derive(Clone, Debug, PartialEq)]
pub struct Area {
    pub polygons: Vec<Polygon>,
    /// Factor on the weight of what is inside, at least 0.
    pub weight: f64,
    /// Wanted ground sampling distance inside, scene units per pixel.
    pub gsd: Option<f64>,
}

/// Rings of a polygon, the outer one first, then its holes; the first position may be repeated at
/// the end.
pub type Polygon = Vec<Vec<[f64; 2]>>;

/// Polygons in the coordinates of their file.
#[derive(Clone, Debug)]
pub struct MapAreas {
    /// In the order of the file.
    polygons: Vec<PreparedPolygon>,
    rings: Vec<Polygon>,
    /// By polygon.
    wishes: Vec<RegionProperties>,
    columns: Columns,
    projection: Projection,
}

/// Projection from world coordinates to those of the file.
#[derive(Clone, Copy, Debug)]
pub enum Projection {
    /// Longitude and latitude, degrees.
    Geodetic(Georeference),
    /// Scene units along two axes; `origin` is on the map's ground.
    Axes {
        axes: [Vector3<f64>; 3],
        origin: Point3<f64>,
    },
}

impl Projection {
    fn new(
        coordinates: Coordinates,
        place: &Georeference,
        frame: &MapFrame,
    ) -> Result<Self, ShapeError> {
        let on_the_map = Self::Axes {
            axes: frame.axes,
            origin: frame.origin,
        };
        match (coordinates, place) {
            (Coordinates::Geodetic, Georeference::Local) => Err(ShapeError::NoGeoreference),
            (Coordinates::Model { axes: Some(axes) }, _) => {
                let axes = axes.map(Vector3::from);
                // Comparisons with NaN are false.
                let are_units = axes.iter().all(|axis| (axis.norm() - 1.0).abs() < UNIT);
                if are_units {
                    Ok(Self::Axes {
                        axes,
                        origin: frame.origin,
                    })
                } else {
                    Err(ShapeError::Axes)
                }
            }
            (Coordinates::Model { axes: None }, _) | (Coordinates::Unsaid, Georeference::Local) => {
                Ok(on_the_map)
            }
            (Coordinates::Unsaid | Coordinates::Geodetic, place) => Ok(Self::Geodetic(*place)),
        }
    }

    fn project(&self, point: &Point3<f64>) -> [f64; 2] {
        match self {
            Self::Geodetic(place) => place
                .geodetic(point)
                .map_or([f64::NAN; 2], |at| [at.longitude, at.latitude]),
            Self::Axes {
                axes: [x, y, _], ..
            } => [x.dot(&point.coords), y.dot(&point.coords)],
        }
    }

    /// Shifts a position by whole turns of longitude to within half a turn of another.
    fn beside(&self, from: [f64; 2], to: [f64; 2]) -> [f64; 2] {
        match self {
            Self::Geodetic(_) => [to[0] - 360.0 * ((to[0] - from[0]) / 360.0).round(), to[1]],
            Self::Axes { .. } => to,
        }
    }

    /// Undoes [`Self::beside`].
    fn wrapped(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        match self {
            Self::Geodetic(_) if x > 180.0 => [x - 360.0, y],
            Self::Geodetic(_) if x < -180.0 => [x + 360.0, y],
            _ => [x, y],
        }
    }
}

fn check_degrees(polygons: &[Polygon]) -> Result<(), ShapeError> {
    let on_earth = |p: &&[f64; 2]| p[0].abs() <= 180.0 && p[1].abs() <= 90.0;
    match polygons.iter().flatten().flatten().find(|p| !on_earth(p)) {
        Some(&[x, y]) => Err(ShapeError::NotDegrees { x, y }),
        None => Ok(()),
    }
}

impl MapAreas {
    pub fn new(areas: Areas, place: &Georeference, frame: &MapFrame) -> Result<Self, ShapeError> {
        let projection = Projection::new(areas.coordinates, place, frame)?;
        let wishes = areas.areas.iter().flat_map(|area| {
            let wish = RegionProperties {
                weight: area.weight,
                gsd: area.gsd,
            };
            std::iter::repeat_n(wish, area.polygons.len())
        });
        let wishes = wishes.collect();
        let areas = areas.areas.into_iter();
        let rings: Vec<Polygon> = areas.flat_map(|area| area.polygons).collect();
        if let Projection::Geodetic(_) = projection {
            check_degrees(&rings)?;
        }
        let prepared = |rings: &Polygon| PreparedPolygon::new(rings);
        let polygons: Vec<PreparedPolygon> = rings.iter().map(prepared).collect();
        let bounds: Vec<Rectangle> = polygons.iter().map(|polygon| polygon.bounds).collect();
        Ok(Self {
            columns: Columns::new(&bounds),
            polygons,
            rings,
            wishes,
            projection,
        })
    }

    /// Returns the properties of the last polygon that contains the position. Adds the polygons and
    /// edges that it looks at to `looked_at`.
    fn at(&self, place: [f64; 2], looked_at: &mut u64) -> Option<RegionProperties> {
        let holds = |&&i: &&u32| {
            *looked_at += 1;
            self.polygons[i as usize].contains(place, looked_at)
        };
        let holding = self.columns.cell(place).iter().rev().find(holds);
        holding.map(|&i| self.wishes[i as usize])
    }

    pub fn sampled(
        &self,
        surface: &Surface,
        watcher: &dyn Watcher,
    ) -> Result<Vec<TriangleSamples>, RegionError> {
        // Once per vertex: within a triangle, the projection is as good as linear.
        let vertices: Vec<[f64; 2]> = surface
            .vertices
            .par_iter()
            .map(|v| self.projection.project(v))
            .collect();
        in_parts(surface, watcher, |t, looked_at| {
            let [a, b, c] = surface.triangles[t as usize].map(|v| vertices[v as usize]);
            let [b, c] = [b, c].map(|corner| self.projection.beside(a, corner));
            let at = |u: f64, v: f64| {
                [0, 1].map(|axis| a[axis] + u * (b[axis] - a[axis]) + v * (c[axis] - a[axis]))
            };
            sampled(|[u, v]| self.at(self.projection.wrapped(at(u, v)), looked_at))
        })
    }

    /// Returns the properties at a place that counts: it is in an area of positive weight.
    pub fn counted(&self, place: &Point3<f64>, looked_at: &mut u64) -> Option<RegionProperties> {
        let at = self.projection.wrapped(self.projection.project(place));
        let found = self.at(at, looked_at);
        found.filter(|properties| properties.weight > 0.0)
    }

    /// Edges of all areas.
    pub fn edges(&self) -> usize {
        self.rings.iter().flatten().map(Vec::len).sum()
    }

    /// Rings of all areas on the map of a plane; `None` if a position is not on it.
    pub fn on_the_map(&self, plane: &GroundPlane) -> Option<Vec<Vec<[f64; 2]>>> {
        let place = |at: &[f64; 2]| {
            plane.invert(*at, |point| {
                self.projection.beside(*at, self.projection.project(point))
            })
        };
        let rings = self.rings.iter().flatten();
        rings.map(|ring| ring.iter().map(place).collect()).collect()
    }

    /// Area of the polygons that count; `rings`: their rings on a map, in their order.
    pub fn area(&self, rings: &[Vec<[f64; 2]>]) -> f64 {
        let mut rest = rings;
        let polygons = self.rings.iter().zip(&self.wishes);
        let areas = polygons.map(|(polygon, wish)| {
            let (of_polygon, after) = rest.split_at(polygon.len());
            rest = after;
            (wish.weight > 0.0).then(|| polygon_area(of_polygon))
        });
        areas.flatten().sum()
    }

    pub fn outside(&self, surface: &Surface) -> RegionError {
        let vertices = surface.vertices.iter().map(|v| self.projection.project(v));
        self.outside_of(&vertices.collect::<Vec<_>>())
    }

    /// The error of polygons that are probably in degrees, where the model has no place on earth
    /// and no point of it is near them.
    pub fn in_degrees(&self, points: &[Point3<f64>]) -> Option<RegionError> {
        let points: Vec<[f64; 2]> = points.iter().map(|x| self.projection.project(x)).collect();
        let Rectangle { low, high } = self.rectangle();
        let is_in = |x: &[f64; 2]| (0..2).all(|axis| low[axis] <= x[axis] && x[axis] <= high[axis]);
        let error = self.outside_of(&points);
        (error.is_in_degrees() && !points.iter().any(is_in)).then_some(error)
    }

    fn outside_of(&self, points: &[[f64; 2]]) -> RegionError {
        RegionError::OutsideMap {
            region: self.rectangle(),
            model: Rectangle::around(points),
            is_geodetic: matches!(self.projection, Projection::Geodetic(_)),
        }
    }

    fn rectangle(&self) -> Rectangle {
        Rectangle::around(self.rings.iter().flatten().flatten())
    }

    pub fn outline(&self) -> Outline {
        let Projection::Axes {
            axes: [x, y, up],
            origin,
        } = &self.projection
        else {
            return Outline::Geodetic(self.rings.clone());
        };
        let height = up.dot(&origin.coords);
        let world = |at: &[f64; 2]| Point3::from(x * at[0] + y * at[1] + up * height);
        let polygon = |rings: &Polygon| {
            rings
                .iter()
                .map(|ring| ring.iter().map(world).collect())
                .collect()
        };
        Outline::Polygons(self.rings.iter().map(polygon).collect())
    }
}
