//! Features of the cells of a picture (method 7.3): colour, contrast and structure at three scales, the surrounding cells, and
//! self-similarity. No feature depends on the position in the picture.

use super::image::{Image, span};

/// Side of a cell, pixels of the reduced picture.
const CELL: u32 = 8;
/// Scales at which structure is measured, each half of the previous one.
const SCALES: usize = 3;
/// Offset, pixels of the half-size picture, at which a cell is compared with its neighbourhood: one cell.
const SHIFT: isize = 4;
/// Grey value from which a pixel counts as saturated, and up to which it counts as black.
const SATURATED: u8 = 250;
const BLACK: u8 = 5;

/// Number of features.
pub const COUNT: usize = 29;

/// Features of a grid of cells that covers a picture.
#[derive(Clone, Debug, PartialEq)]
pub struct Features {
    pub columns: u32,
    pub rows: u32,
    /// [`COUNT`] numbers per cell, cells row by row.
    values: Vec<f32>,
}

/// Returns the number of cells that cover a picture: columns, rows.
pub fn grid(width: u32, height: u32) -> [u32; 2] {
    [width.div_ceil(CELL), height.div_ceil(CELL)]
}

impl Features {
    pub fn new(image: &Image) -> Self {
        let [columns, rows] = grid(image.width, image.height);
        let colours = Colours::cells(image, [columns, rows]);
        let structure = Structure::cells(image, [columns, rows]);
        let near = NeighbourhoodFeatures::new(&colours, &structure[0], columns as usize, 1);
        let far = NeighbourhoodFeatures::new(&colours, &structure[0], columns as usize, 4);
        let likeness = likeness(image, [columns, rows]);
        let mut values = Vec::with_capacity(colours.len() * COUNT);
        for cell in 0..colours.len() {
            let start = values.len();
            let own = &colours[cell];
            values.extend(own.mean);
            values.extend(own.spread);
            values.extend([own.bright, own.dark, own.saturation()]);
            let log = structure.each_ref().map(|scale| scale[cell].log_eigenvalues());
            values.extend(log.iter().flat_map(|[large, small]| [*large, *small, large - small]));
            values.extend([log[0][0] - log[1][0], log[1][0] - log[2][0]]);
            for around in [&near, &far] {
                values.extend([own.mean[0] - around.mean[cell][0], around.small[cell]]);
            }
            values.extend([far.mean[cell][1], far.mean[cell][2], far.brightness_spread[cell]]);
            values.extend(likeness[cell]);
            debug_assert_eq!(values.len() - start, COUNT);
        }
        Self { columns, rows, values }
    }

    pub fn cells(&self) -> usize {
        self.columns as usize * self.rows as usize
    }

    /// Returns the features of a cell; cells are counted row by row.
    pub fn cell(&self, cell: usize) -> &[f32] {
        &self.values[cell * COUNT..(cell + 1) * COUNT]
    }
}

/// Colour of a cell.
#[derive(Clone, Copy, Debug, Default)]
pub struct Colours {
    /// Grey value, red-green and blue-yellow difference, the latter two relative to the grey value.
    mean: [f32; 3],
    /// Standard deviations of grey value, red minus green, blue minus yellow.
    spread: [f32; 3],
    /// Shares of saturated and of black pixels.
    pub bright: f32,
    pub dark: f32,
}

impl Colours {
    pub fn cells(image: &Image, grid: [u32; 2]) -> Vec<Self> {
        each_cell(image.width, image.height, grid, |columns, rows| {
            let pixels = columns.len() * rows.len();
            let (mut sums, mut squares) = ([0.0f32; 3], [0.0f32; 3]);
            let (mut bright, mut dark) = (0, 0);
            for y in rows {
                let line = &image.rgb[3 * (y * image.width as usize + columns.start)..][..3 * columns.len()];
                for rgb in line.chunks_exact(3) {
                    let [r, g, b] = [rgb[0], rgb[1], rgb[2]].map(f32::from);
                    let opponents = [grey([r, g, b]), r - g, b - 0.5 * (r + g)];
                    for (i, value) in opponents.into_iter().enumerate() {
                        sums[i] += value;
                        squares[i] += value * value;
                    }
                    let most = rgb[0].max(rgb[1]).max(rgb[2]);
                    bright += u32::from(most >= SATURATED);
                    dark += u32::from(most <= BLACK);
                }
            }
            let n = pixels as f32;
            let mean = sums.map(|sum| sum / n);
            let spread = [0, 1, 2].map(|i| (squares[i] / n - mean[i] * mean[i]).max(0.0).sqrt());
            let over = 1.0 / (mean[0] + 10.0);
            Self {
                mean: [mean[0], mean[1] * over, mean[2] * over],
                spread,
                bright: bright as f32 / n,
                dark: dark as f32 / n,
            }
        })
    }

    fn saturation(&self) -> f32 {
        self.mean[1].hypot(self.mean[2])
    }
}

/// Structure tensor of a cell at one scale: means of the products of the gradient, squared grey values per squared pixel.
#[derive(Clone, Copy, Debug, Default)]
pub struct Structure {
    xx: f32,
    xy: f32,
    yy: f32,
}

impl Structure {
    /// Computes the tensor of each cell at each scale, finest first.
    pub fn cells(image: &Image, grid: [u32; 2]) -> [Vec<Self>; SCALES] {
        let mut level = Level::new(image);
        std::array::from_fn(|scale| {
            if scale > 0 {
                level = level.halved();
            }
            let cells = each_cell(level.width as u32, level.height as u32, grid, |columns, rows| {
                let n = (columns.len() * rows.len()) as f32;
                let mut sum = Self::default();
                for y in rows {
                    for x in columns.clone() {
                        let [dx, dy] = level.gradient(x, y);
                        sum.xx += dx * dx;
                        sum.xy += dx * dy;
                        sum.yy += dy * dy;
                    }
                }
                Self { xx: sum.xx / n, xy: sum.xy / n, yy: sum.yy / n }
            });
            // A cell has few pixels at the coarser scales.
            if scale == 0 { cells } else { around(&cells, grid[0] as usize, 1, Self::mean) }
        })
    }

    /// Returns the large and the small eigenvalue.
    pub fn eigenvalues(&self) -> [f32; 2] {
        let (half, apart) = (0.5 * (self.xx + self.yy), (0.5 * (self.xx - self.yy)).hypot(self.xy));
        [half + apart, (half - apart).max(0.0)]
    }

    fn log_eigenvalues(&self) -> [f32; 2] {
        self.eigenvalues().map(log)
    }

    fn mean(cells: &mut dyn Iterator<Item = &Self>) -> Self {
        let (mut sum, mut n) = (Self::default(), 0.0);
        for cell in cells {
            sum = Self { xx: sum.xx + cell.xx, xy: sum.xy + cell.xy, yy: sum.yy + cell.yy };
            n += 1.0;
        }
        Self { xx: sum.xx / n, xy: sum.xy / n, yy: sum.yy / n }
    }
}

/// Features of the cells around each cell.
struct NeighbourhoodFeatures {
    mean: Vec<[f32; 3]>,
    /// Mean logarithm of the small eigenvalue.
    small: Vec<f32>,
    brightness_spread: Vec<f32>,
}

impl NeighbourhoodFeatures {
    /// Averages over the cells within `reach`.
    fn new(colours: &[Colours], structure: &[Structure], columns: usize, reach: usize) -> Self {
        let channel = |i: usize| around(&colours.iter().map(|c| c.mean[i]).collect::<Vec<_>>(), columns, reach, mean);
        let [grey, red, blue] = [0, 1, 2].map(channel);
        let squares: Vec<f32> = colours.iter().map(|c| c.mean[0] * c.mean[0]).collect();
        let squares = around(&squares, columns, reach, mean);
        let small: Vec<f32> = structure.iter().map(|s| s.log_eigenvalues()[1]).collect();
        Self {
            small: around(&small, columns, reach, mean),
            brightness_spread: squares.iter().zip(&grey).map(|(s, m)| (s - m * m).max(0.0).sqrt()).collect(),
            mean: (0..grey.len()).map(|i| [grey[i], red[i], blue[i]]).collect(),
        }
    }
}

/// Minimum and mean difference between a cell and the picture one cell away in eight directions, relative to the cell's contrast. A small
/// minimum indicates repetition or no texture.
fn likeness(image: &Image, grid: [u32; 2]) -> Vec<[f32; 2]> {
    let level = Level::new(image).halved();
    let directions = [(-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1)];
    each_cell(level.width as u32, level.height as u32, grid, |columns, rows| {
        let difference = |(dy, dx): (isize, isize)| {
            let mut sum = 0.0;
            for y in rows.clone() {
                for x in columns.clone() {
                    sum += (level.at(x as isize, y as isize)
                        - level.at(x as isize + dx * SHIFT, y as isize + dy * SHIFT))
                    .abs();
                }
            }
            sum / (columns.len() * rows.len()) as f32
        };
        let differences = directions.map(difference);
        let mean = differences.iter().sum::<f32>() / differences.len() as f32;
        [differences.iter().copied().fold(f32::INFINITY, f32::min), mean].map(log)
    })
}

/// Grey values of a picture at some scale.
struct Level {
    width: usize,
    height: usize,
    grey: Vec<f32>,
}

impl Level {
    fn new(image: &Image) -> Self {
        let grey = image.rgb.chunks_exact(3).map(|rgb| grey([rgb[0], rgb[1], rgb[2]].map(f32::from))).collect();
        Self { width: image.width as usize, height: image.height as usize, grey }
    }

    /// Halves the size; an odd last row or column is dropped, unless it is the only one.
    fn halved(&self) -> Self {
        let (width, height) = ((self.width / 2).max(1), (self.height / 2).max(1));
        let mut grey = Vec::with_capacity(width * height);
        for y in 0..height as isize {
            for x in 0..width as isize {
                let of = |dx, dy| self.at(2 * x + dx, 2 * y + dy);
                grey.push(0.25 * (of(0, 0) + of(1, 0) + of(0, 1) + of(1, 1)));
            }
        }
        Self { width, height, grey }
    }

    /// Returns the pixel, clamped to the border.
    #[inline]
    fn at(&self, x: isize, y: isize) -> f32 {
        let x = x.clamp(0, self.width as isize - 1) as usize;
        let y = y.clamp(0, self.height as isize - 1) as usize;
        self.grey[y * self.width + x]
    }

    /// Returns central differences, grey values per pixel.
    #[inline]
    fn gradient(&self, x: usize, y: usize) -> [f32; 2] {
        let (x, y) = (x as isize, y as isize);
        [0.5 * (self.at(x + 1, y) - self.at(x - 1, y)), 0.5 * (self.at(x, y + 1) - self.at(x, y - 1))]
    }
}

fn grey([r, g, b]: [f32; 3]) -> f32 {
    0.299 * r + 0.587 * g + 0.114 * b
}

/// Returns the logarithm of a non-negative number, finite at 0.
fn log(value: f32) -> f32 {
    (value + 0.01).log2()
}

/// Applies `of(columns, rows)` to the pixels of each cell, row by row.
fn each_cell<T>(
    width: u32,
    height: u32,
    grid: [u32; 2],
    of: impl Fn(std::ops::Range<usize>, std::ops::Range<usize>) -> T,
) -> Vec<T> {
    let cells = (0..grid[1]).flat_map(|row| (0..grid[0]).map(move |column| (column, row)));
    cells.map(|(column, row)| of(span(width, grid[0], column), span(height, grid[1], row))).collect()
}

/// Averages `mean` over the cells within `reach` of each cell.
fn around<T>(cells: &[T], columns: usize, reach: usize, mean: impl Fn(&mut dyn Iterator<Item = &T>) -> T) -> Vec<T> {
    let rows = cells.len() / columns;
    let of = |cell: usize| {
        let (column, row) = (cell % columns, cell / columns);
        let lines = row.saturating_sub(reach)..(row + reach + 1).min(rows);
        let places = column.saturating_sub(reach)..(column + reach + 1).min(columns);
        mean(&mut lines.flat_map(|y| &cells[y * columns..][places.clone()]))
    };
    (0..cells.len()).map(of).collect()
}

fn mean(values: &mut dyn Iterator<Item = &f32>) -> f32 {
    let (sum, n) = values.fold((0.0, 0.0), |(sum, n), value| (sum + value, n + 1.0));
    sum / n
}
