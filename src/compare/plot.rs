//! The energy curve as a picture: how d2 grows while triangles go.
//!
//! Invariants:
//! 1. a curve is thinned only where its points fall on one another;
//! 2. d2 is on a logarithmic axis only when its range is wide and starts above zero.
//!
//! Knows nothing of files: SVG text comes out.

use std::ops::Range;

use plotters::{
    backend::SVGBackend,
    coord::Shift,
    drawing::{DrawingArea, DrawingAreaErrorKind, IntoDrawingArea},
    element::{Circle, PathElement, Rectangle, Text},
    style::{
        Color, FontTransform, IntoFont, RGBColor, ShapeStyle, TextStyle,
        text_anchor::{HPos, Pos, VPos},
    },
};

use crate::mesh::Stage;

/// A point of the energy curve, as far as a plot needs it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CurvePoint {
    /// The stage that took it.
    pub stage: Stage,
    /// Energy evaluations of the stage so far.
    pub evaluations: u64,
    /// Triangles then.
    pub triangles: u32,
    /// Which level is being optimized; absent in other stages.
    pub level: Option<u32>,
    /// What is drawn: d2 in percent of full scale, unless [`PlotParams::y`] says otherwise; absent
    /// where no pictures were kept.
    pub d2: Option<f64>,
}

/// What runs along the horizontal axis.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum PlotX {
    /// Triangles, descending, logarithmic.
    #[default]
    Triangles,
    /// Evaluations of all stages that keep pictures.
    Evaluations,
}

/// How to draw a curve.
#[derive(Clone, Debug, PartialEq)]
pub struct PlotParams {
    /// Title of the plot.
    pub title: String,
    /// What runs along the horizontal axis.
    pub x: PlotX,
    /// What stands along the vertical axis.
    pub y: &'static str,
    /// Triangles of the levels of detail, in the order asked for; each is marked on the curve.
    pub levels: Vec<u32>,
    /// Width of the picture, pixels, at least 320.
    pub width: u32,
    /// Height of the picture, pixels, at least 240.
    pub height: u32,
}

impl Default for PlotParams {
    fn default() -> Self {
        let title = "Image difference while simplifying".to_owned();
        let y = "d2, percent of full scale";
        Self { title, x: PlotX::default(), y, levels: Vec::new(), width: 900, height: 520 }
    }
}

/// Draws the curve; returns an SVG document.
pub fn energy_plot(samples: &[CurvePoint], params: &PlotParams) -> String {
    let size = (params.width.max(320), params.height.max(240));
    let mut svg = String::new();
    {
        let area = SVGBackend::with_string(&mut svg, (size.0 * FINE, size.1 * FINE));
        // Writing into a String cannot fail.
        let drawn = Plot::new(samples, params, size).draw(&area.into_drawing_area());
        debug_assert!(drawn.is_ok(), "{drawn:?}");
    }
    // The backend knows whole pixels only, so it draws on a finer grid than is shown.
    let fine = format!("width=\"{}\" height=\"{}\"", size.0 * FINE, size.1 * FINE);
    svg.replacen(&fine, &format!("width=\"{}\" height=\"{}\"", size.0, size.1), 1)
}

/// Grid lines a pixel.
const FINE: u32 = 4;

const PAPER: RGBColor = RGBColor(255, 255, 255);
const INK: RGBColor = RGBColor(38, 42, 51);
const FAINT: RGBColor = RGBColor(112, 119, 133);
const GRID: RGBColor = RGBColor(229, 232, 238);

fn stage_colour(stage: Stage) -> RGBColor {
    match stage {
        Stage::Memoryless => RGBColor(132, 142, 160),
        Stage::Image => RGBColor(37, 99, 217),
        Stage::Optimize => RGBColor(214, 98, 28),
    }
}

type Canvas<'a> = DrawingArea<SVGBackend<'a>, Shift>;
type Drawn = Result<(), DrawingAreaErrorKind<std::io::Error>>;

/// An axis: values to grid lines of the picture.
struct Axis {
    /// From the left or bottom end to the other, in values; descending for triangles.
    values: Range<f64>,
    logarithmic: bool,
    /// From the left or bottom end to the other, in grid lines.
    grid: Range<f64>,
}

impl Axis {
    fn at(&self, value: f64) -> i32 {
        let scale = |v: f64| if self.logarithmic { libm::log10(v) } else { v };
        let (start, end) = (scale(self.values.start), scale(self.values.end));
        // A value below a logarithmic axis, such as no difference at all, sits on its end.
        let (low, high) = (start.min(end), start.max(end));
        let part = (scale(value).clamp(low, high) - start) / (end - start);
        libm::round(self.grid.start + part * (self.grid.end - self.grid.start)) as i32
    }

    /// Round values within the axis.
    fn ticks(&self) -> Vec<f64> {
        let (low, high) =
            (self.values.start.min(self.values.end), self.values.start.max(self.values.end));
        let slack = 1.0 + 1e-9;
        let within = |v: &f64| *v * slack >= low && *v <= high * slack;
        if self.logarithmic {
            let decades =
                libm::floor(libm::log10(low)) as i32..=libm::ceil(libm::log10(high)) as i32;
            // The wider the range, the fewer steps in a decade.
            let steps: &[f64] = match high / low {
                ..10.0 => &[1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0],
                ..2e3 => &[1.0, 2.0, 5.0],
                _ => &[1.0],
            };
            return decades
                .flat_map(|d| steps.iter().map(move |s| s * libm::pow(10.0, f64::from(d))))
                .filter(within)
                .collect();
        }
        let step = round_step((high - low) / 5.0);
        let first = libm::ceil(low / step) as i64;
        (first..).map(|i| i as f64 * step).take_while(|v| *v <= high * slack).collect()
    }
}

/// The next of 1, 2, 5 times a power of ten at or above a value.
fn round_step(value: f64) -> f64 {
    let power = libm::pow(10.0, libm::floor(libm::log10(value.max(f64::MIN_POSITIVE))));
    [1.0, 2.0, 5.0, 10.0].map(|s| s * power).into_iter().find(|s| *s >= value).unwrap_or(power)
}

/// A curve point in the units of the axes.
#[derive(Clone, Copy)]
struct Spot {
    stage: Stage,
    level: Option<u32>,
    x: f64,
    d2: f64,
    triangles: u32,
}

struct Plot<'a> {
    params: &'a PlotParams,
    spots: Vec<Spot>,
    /// Triangles before and after the stages without pictures, if any.
    unseen: Option<(u32, u32)>,
    x: Axis,
    y: Axis,
}

impl<'a> Plot<'a> {
    fn new(samples: &[CurvePoint], params: &'a PlotParams, size: (u32, u32)) -> Self {
        let spots = spots(samples, params.x);
        let mut unseen = samples.iter().filter(|s| s.d2.is_none()).map(|s| s.triangles);
        let unseen = unseen.next().map(|first| (first, unseen.next_back().unwrap_or(first)));
        let (width, height) = (f64::from(size.0), f64::from(size.1));
        let left = 76.0 + if unseen.is_some() { 52.0 } else { 0.0 };
        let fine = |v: f64| v * f64::from(FINE);
        Self {
            params,
            x: x_axis(&spots, params.x, fine(left)..fine(width - 28.0)),
            y: y_axis(&spots, fine(height - 62.0)..fine(66.0)),
            spots,
            unseen,
        }
    }

    fn draw(&self, canvas: &Canvas<'_>) -> Drawn {
        canvas.fill(&PAPER)?;
        self.draw_unseen(canvas)?;
        self.draw_grid(canvas)?;
        self.draw_labels(canvas)?;
        self.draw_curves(canvas)?;
        self.draw_levels(canvas)?;
        self.draw_legend(canvas)?;
        canvas.present()
    }

    fn left(&self) -> i32 {
        self.x.grid.start as i32
    }
    fn right(&self) -> i32 {
        self.x.grid.end as i32
    }
    fn bottom(&self) -> i32 {
        self.y.grid.start as i32
    }
    fn top(&self) -> i32 {
        self.y.grid.end as i32
    }

    /// A band for what happened before pictures were kept.
    fn draw_unseen(&self, canvas: &Canvas<'_>) -> Drawn {
        let Some((from, to)) = self.unseen else { return Ok(()) };
        let colour = stage_colour(Stage::Memoryless);
        let band = [(self.left() - px(52), self.top()), (self.left(), self.bottom())];
        canvas.draw(&Rectangle::new(band, colour.mix(0.16).filled()))?;
        let words = format!("memoryless: {} → {}", thousands(from), thousands(to));
        let style =
            text(13.0, FAINT, HPos::Center, VPos::Center).transform(FontTransform::Rotate270);
        let middle = i32::midpoint(self.top(), self.bottom());
        canvas.draw(&Text::new(words, (self.left() - px(25), middle), style))
    }

    fn draw_grid(&self, canvas: &Canvas<'_>) -> Drawn {
        let line = |from, to, colour: RGBColor| PathElement::new(vec![from, to], stroke(colour, 1));
        for value in self.y.ticks() {
            let y = self.y.at(value);
            canvas.draw(&line((self.left(), y), (self.right(), y), GRID))?;
            let style = text(13.0, FAINT, HPos::Right, VPos::Center);
            let x = self.left() - px(if self.unseen.is_some() { 60 } else { 8 });
            canvas.draw(&Text::new(percent(value), (x, y), style))?;
        }
        for value in self.x.ticks() {
            let x = self.x.at(value);
            canvas.draw(&line((x, self.top()), (x, self.bottom()), GRID))?;
            let style = text(13.0, FAINT, HPos::Center, VPos::Top);
            canvas.draw(&Text::new(thousands(value as u32), (x, self.bottom() + px(7)), style))?;
        }
        let (left, right, bottom) = (self.left(), self.right(), self.bottom());
        canvas.draw(&line((left, bottom), (right, bottom), FAINT))
    }

    fn draw_labels(&self, canvas: &Canvas<'_>) -> Drawn {
        let title = text(18.0, INK, HPos::Left, VPos::Top);
        canvas.draw(&Text::new(self.params.title.clone(), (px(24), px(18)), title))?;
        let below = match self.params.x {
            PlotX::Triangles => "triangles",
            PlotX::Evaluations => "evaluations",
        };
        let (middle_x, middle_y) =
            (i32::midpoint(self.left(), self.right()), i32::midpoint(self.top(), self.bottom()));
        let style = text(14.0, INK, HPos::Center, VPos::Top);
        canvas.draw(&Text::new(below, (middle_x, self.bottom() + px(32)), style))?;
        let style = text(14.0, INK, HPos::Center, VPos::Top).transform(FontTransform::Rotate270);
        canvas.draw(&Text::new(self.params.y, (px(12), middle_y), style))?;
        if self.spots.is_empty() {
            let style = text(14.0, FAINT, HPos::Center, VPos::Center);
            canvas.draw(&Text::new("no stage kept pictures", (middle_x, middle_y), style))?;
        }
        Ok(())
    }

    /// A mark where each level of detail was reached.
    fn draw_levels(&self, canvas: &Canvas<'_>) -> Drawn {
        for (level, triangles) in self.params.levels.iter().enumerate() {
            // The end of its optimization, or else where simplification reached it.
            let optimized = self.spots.iter().rfind(|s| s.level == Some(level as u32));
            let reached = || self.spots.iter().find(|s| s.triangles <= *triangles);
            let Some(spot) = optimized.or_else(reached) else { continue };
            let (x, y) = (self.x.at(spot.x), self.y.at(spot.d2));
            for dash in (self.top()..self.bottom()).step_by(px(8) as usize) {
                let end = (dash + px(4)).min(self.bottom());
                let style = stroke(FAINT, 1);
                canvas.draw(&PathElement::new(vec![(x, dash), (x, end)], style))?;
            }
            canvas.draw(&Circle::new((x, y), px(4), INK.filled()))?;
            let words = format!("LOD {level}: {}, {}", thousands(*triangles), percent(spot.d2));
            // The curve rises to the right, so above it to the left, or below to the right.
            let (at, style) = if x - self.left() > px(160) {
                ((x - px(9), y - px(4)), text(13.0, INK, HPos::Right, VPos::Bottom))
            } else {
                ((x + px(9), y + px(6)), text(13.0, INK, HPos::Left, VPos::Top))
            };
            canvas.draw(&Text::new(words, at, style))?;
        }
        Ok(())
    }

    fn draw_curves(&self, canvas: &Canvas<'_>) -> Drawn {
        for run in self.spots.chunk_by(|a, b| (a.stage, a.level) == (b.stage, b.level)) {
            let points = self.thinned(run);
            let style = stroke(stage_colour(run[0].stage), 2);
            canvas.draw(&PathElement::new(points, style))?;
        }
        Ok(())
    }

    /// Positions on the grid, without those that fall within half a pixel of the one before.
    fn thinned(&self, run: &[Spot]) -> Vec<(i32, i32)> {
        let mut points: Vec<(i32, i32)> = Vec::new();
        for (i, spot) in run.iter().enumerate() {
            let point = (self.x.at(spot.x), self.y.at(spot.d2));
            let near = points.last().is_some_and(|last| {
                (last.0 - point.0).abs().max((last.1 - point.1).abs()) < px(1) / 2
            });
            if !near || i + 1 == run.len() {
                points.push(point);
            }
        }
        points
    }

    fn draw_legend(&self, canvas: &Canvas<'_>) -> Drawn {
        let mut x = self.right();
        for stage in [Stage::Optimize, Stage::Image, Stage::Memoryless] {
            if !self.spots.iter().any(|s| s.stage == stage) {
                continue;
            }
            let style = text(13.0, INK, HPos::Right, VPos::Center);
            canvas.draw(&Text::new(stage.name(), (x, px(48)), style))?;
            x -= px(7 * stage.name().len() as i32 + 12);
            let line = vec![(x - px(20), px(48)), (x, px(48))];
            canvas.draw(&PathElement::new(line, stroke(stage_colour(stage), 3)))?;
            x -= px(38);
        }
        Ok(())
    }
}

/// Evaluations are counted through all the stages that keep pictures.
fn spots(samples: &[CurvePoint], x: PlotX) -> Vec<Spot> {
    let mut spots: Vec<Spot> = Vec::new();
    let (mut before, mut last) = (0, 0);
    for sample in samples {
        let Some(d2) = sample.d2.filter(|d2| d2.is_finite()) else { continue };
        if spots.last().is_some_and(|s| s.stage != sample.stage) {
            before += last;
        }
        last = sample.evaluations;
        let x = match x {
            PlotX::Triangles => f64::from(sample.triangles.max(1)),
            PlotX::Evaluations => (before + last) as f64,
        };
        let CurvePoint { stage, level, triangles, .. } = *sample;
        spots.push(Spot { stage, level, x, d2, triangles });
    }
    spots
}

fn x_axis(spots: &[Spot], x: PlotX, grid: Range<f64>) -> Axis {
    let extent = extent(spots.iter().map(|s| s.x));
    match x {
        PlotX::Triangles => {
            let (low, high) = extent.unwrap_or((1.0, 1000.0));
            // At least a tenth of a decade, so that a single point has an axis.
            let high = high.max(low * 1.26);
            Axis { values: high..low, logarithmic: true, grid }
        }
        PlotX::Evaluations => {
            let high = extent.map_or(1.0, |e| e.1).max(1.0);
            Axis { values: 0.0..high, logarithmic: false, grid }
        }
    }
}

fn y_axis(spots: &[Spot], grid: Range<f64>) -> Axis {
    let (low, high) = extent(spots.iter().map(|s| s.d2)).unwrap_or((0.0, 1.0));
    let high = if high > 0.0 { high } else { 1.0 };
    if low > 0.0 && high / low > 30.0 {
        return Axis { values: low..high, logarithmic: true, grid };
    }
    let step = round_step(high / 5.0);
    Axis { values: 0.0..step * libm::ceil(high / step), logarithmic: false, grid }
}

fn extent(values: impl Iterator<Item = f64>) -> Option<(f64, f64)> {
    values.fold(None, |all, v| {
        let (low, high) = all.unwrap_or((v, v));
        Some((v.min(low), v.max(high)))
    })
}

/// Pixels to grid lines.
fn px(pixels: i32) -> i32 {
    pixels * FINE as i32
}

fn stroke(colour: RGBColor, pixels: i32) -> ShapeStyle {
    colour.stroke_width(px(pixels) as u32)
}

fn text(pixels: f64, colour: RGBColor, horizontal: HPos, vertical: VPos) -> TextStyle<'static> {
    // The backend divides sizes by 1.24.
    let size = pixels * f64::from(FINE) * 1.24;
    TextStyle {
        font: ("sans-serif", size).into_font(),
        color: colour.to_backend_color(),
        pos: Pos::new(horizontal, vertical),
    }
}

fn percent(value: f64) -> String {
    let text = format!("{value:.3}");
    format!("{} %", text.trim_end_matches('0').trim_end_matches('.'))
}

fn thousands(n: u32) -> String {
    super::sheet::thousands(n as usize)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn curve() -> Vec<CurvePoint> {
        let point = |stage, evaluations, triangles, d2| {
            let level = (stage == Stage::Optimize).then_some(1);
            CurvePoint { stage, evaluations, triangles, level, d2 }
        };
        let mut points = vec![
            point(Stage::Memoryless, 0, 69_451, None),
            point(Stage::Memoryless, 9_000, 5_332, None),
        ];
        for i in 0..2000_u32 {
            let d2 = 1.2 + 2.5 * (f64::from(i) / 2000.0).powi(2);
            points.push(point(Stage::Image, u64::from(i) * 20, 5_332 - 2 * i, Some(d2)));
        }
        points.push(point(Stage::Optimize, 0, 1_332, Some(3.7)));
        points.push(point(Stage::Optimize, 9_000, 1_332, Some(3.1)));
        points
    }

    fn plot(x: PlotX) -> String {
        energy_plot(&curve(), &PlotParams { x, levels: vec![3_000, 1_334], ..Default::default() })
    }

    #[test]
    fn the_plot_names_its_axes_stages_and_levels() {
        let svg = plot(PlotX::Triangles);
        assert!(svg.starts_with("<svg width=\"900\" height=\"520\" viewBox=\"0 0 3600 2080\""));
        for words in ["triangles", "percent of full scale", "memoryless: 69,451 → 5,332", "image"]
        {
            assert!(svg.contains(words), "{words}");
        }
        assert!(svg.contains("LOD 0: 3,000") && svg.contains("LOD 1: 1,334, 3.1 %"));
        assert!(plot(PlotX::Evaluations).contains("evaluations"));
        assert!(svg.len() < 60_000, "{} bytes: the curve is not thinned", svg.len());
    }

    #[test]
    fn evaluations_run_on_through_the_stages() {
        let spots = spots(&curve(), PlotX::Evaluations);
        assert_eq!(spots.first().map(|s| s.x), Some(0.0));
        assert_eq!(spots.last().map(|s| s.x), Some(1999.0 * 20.0 + 9_000.0));
        assert!(spots.is_sorted_by_key(|s| s.x));
    }

    #[test]
    fn curves_without_points_or_extent_still_give_a_plot() {
        let (stage, level, d2) = (Stage::Image, None, Some(0.0));
        let point = CurvePoint { stage, evaluations: 0, triangles: 0, level, d2 };
        let unseen = CurvePoint { d2: None, ..point };
        let unbounded = CurvePoint { d2: Some(f64::INFINITY), ..point };
        for samples in [&[][..], &[point], &[point, point], &[unseen], &[unbounded]] {
            for x in [PlotX::Triangles, PlotX::Evaluations] {
                let svg = energy_plot(samples, &PlotParams { x, ..PlotParams::default() });
                assert!(svg.contains("</svg>") && !svg.contains("NaN"));
            }
        }
    }

    #[test]
    fn ticks_are_round_and_within_the_axis() {
        let axis = |values: Range<f64>, logarithmic| Axis { values, logarithmic, grid: 0.0..100.0 };
        assert_eq!(axis(0.0..4.0, false).ticks(), vec![0.0, 1.0, 2.0, 3.0, 4.0]);
        assert_eq!(
            axis(5332.0..1332.0, true).ticks(),
            vec![1500.0, 2000.0, 3000.0, 4000.0, 5000.0]
        );
        assert_eq!(axis(0.5..20.0, true).ticks().len(), 6);
        assert_eq!(axis(5332.0..1332.0, true).at(1332.0), 100);
    }

    #[test]
    fn a_wide_range_of_d2_gets_a_logarithmic_axis() {
        let spot = |d2| Spot { stage: Stage::Image, level: None, x: 1.0, d2, triangles: 1 };
        assert!(y_axis(&[spot(0.05), spot(4.0)], 0.0..1.0).logarithmic);
        assert!(!y_axis(&[spot(0.0), spot(4.0)], 0.0..1.0).logarithmic);
        assert!(!y_axis(&[spot(1.0), spot(4.0)], 0.0..1.0).logarithmic);
    }
}
