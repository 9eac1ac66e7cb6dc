//! Trajectories: polylines, clothoids and NURBS.

use super::element::Element;
use super::model::{Context, Line};
use super::position::place_from;
use crate::ConvertError;

/// Distance between two points of a curve, in metres.
const SPACING_M: f64 = 0.5;

/// Most points of a trajectory: as many as a scenario accepts.
const POINTS: usize = wildcity_sim::limits::COURSE_POINTS;

/// The points of a `<Trajectory>`.
pub(super) fn line_from(
    trajectory: &Element<'_>,
    context: &Context<'_>,
) -> Result<Line, ConvertError> {
    trajectory.only(&["ParameterDeclarations", "Shape"])?;
    let is_closed = trajectory.find_flag("closed")?.unwrap_or(false);
    if is_closed {
        return Err(trajectory.wrong("closed=\"true\" is not read; repeat the first point"));
    }
    let shape = trajectory.need("Shape")?.only_child()?;
    let line = match shape.name() {
        "Polyline" => polyline(&shape, context)?,
        "Clothoid" => clothoid(&shape, context)?,
        "Nurbs" => nurbs(&shape, context)?,
        _ => return Err(shape.unread()),
    };
    if line.points.len() > POINTS {
        let message = format!("{} points; at most {POINTS} are read", line.points.len());
        return Err(shape.wrong(&message));
    }
    Ok(line)
}

fn polyline(shape: &Element<'_>, context: &Context<'_>) -> Result<Line, ConvertError> {
    shape.only(&["Vertex"])?;
    let mut points: Vec<[f64; 3]> = Vec::new();
    let mut times_s: Option<Vec<f64>> = Some(Vec::new());
    for vertex in shape.children() {
        vertex.only(&["Position"])?;
        let position = vertex.need("Position")?;
        let place = place_from(&position, context)?;
        let kind = position.only_child()?;
        let is_turned = kind.find_number("h")?.is_some_and(|h| h != 0.0);
        if is_turned || kind.find("Orientation")?.is_some() {
            shape.note("headings of points are not used: actors face along their line");
        }
        points.push(place.xyz_m);
        // If one vertex has no time, the times of the others are of no use.
        match (&mut times_s, vertex.find_number("time")?) {
            (Some(times_s), Some(time_s)) => times_s.push(time_s),
            _ => times_s = None,
        }
    }
    Ok(Line { points, times_s, is_closed: false })
}

fn clothoid(shape: &Element<'_>, context: &Context<'_>) -> Result<Line, ConvertError> {
    shape.only(&["Position"])?;
    let place = place_from(&shape.need("Position")?, context)?;
    let curvature = shape.number("curvature")?;
    let slope = match shape.find_number("curvaturePrime")? {
        Some(slope) => slope,
        // Files of 1.0 name it so.
        None => shape.number("curvatureDot")?,
    };
    let length_m = shape.number("length")?;
    let times = [shape.find_number("startTime")?, shape.find_number("stopTime")?];
    let count = (length_m.abs() / SPACING_M).ceil().max(1.0);
    if !(length_m > 0.0 && count < POINTS as f64) {
        let most = POINTS as f64 * SPACING_M;
        return Err(shape.wrong(&format!("length={length_m:?}; above 0, at most {most} m")));
    }
    let count = count as usize;
    let step_m = length_m / count as f64;
    let mut points = vec![place.xyz_m];
    let [mut x, mut y, z] = place.xyz_m;
    for index in 0..count {
        // Within a step the heading is a quadratic of the way; Simpson's rule is exact to 1e-9 m.
        let heading_rad = |way_m: f64| {
            let s = index as f64 * step_m + way_m;
            place.yaw_rad + curvature * s + 0.5 * slope * s * s
        };
        // Simpson's rule over a step h: h / 6 (f(0) + 4 f(h / 2) + f(h)).
        let [from, middle, to] = [0.0, 0.5 * step_m, step_m].map(heading_rad);
        x += step_m / 6.0 * (from.cos() + 4.0 * middle.cos() + to.cos());
        y += step_m / 6.0 * (from.sin() + 4.0 * middle.sin() + to.sin());
        points.push([x, y, z]);
    }
    let times_s = match times {
        [Some(start_s), Some(stop_s)] => {
            let share = |index: usize| index as f64 / count as f64;
            Some((0..=count).map(|index| start_s + share(index) * (stop_s - start_s)).collect())
        }
        _ => None,
    };
    Ok(Line { points, times_s, is_closed: false })
}

fn nurbs(shape: &Element<'_>, context: &Context<'_>) -> Result<Line, ConvertError> {
    shape.only(&["ControlPoint", "Knot"])?;
    let order = shape.whole("order")?;
    let mut controls: Vec<[f64; 4]> = Vec::new();
    let mut is_timed = false;
    for control in shape.all("ControlPoint") {
        control.only(&["Position"])?;
        let [x, y, z] = place_from(&control.need("Position")?, context)?.xyz_m;
        let weight = control.find_number("weight")?.unwrap_or(1.0);
        is_timed |= control.find_number("time")?.is_some();
        // In homogeneous coordinates, in which a weighted curve is a plain B-spline.
        controls.push([x * weight, y * weight, z * weight, weight]);
    }
    let knots: Result<Vec<f64>, ConvertError> =
        shape.all("Knot").map(|knot| knot.number("value")).collect();
    let knots = knots?;
    let order = usize::try_from(order).unwrap_or(0);
    let is_ascending = knots.windows(2).all(|pair| pair[0] <= pair[1]);
    let fits = (2..=16).contains(&order)
        && controls.len() >= order
        && controls.len() <= 1000
        && knots.len() == controls.len() + order
        && controls.iter().all(|control| control[3] > 0.0);
    if !(fits && is_ascending) {
        let message = "needs an order of 2 to 16, as many control points, weights above 0, and ascending knots: as many \
                       as control points and order";
        return Err(shape.wrong(message));
    }
    // Where all of `order` basis functions overlap, which is the domain of the curve.
    let from = knots[order - 1];
    let to = knots[controls.len()];
    // The polygon of the control points is no shorter than the curve.
    let polygon_m: f64 = controls
        .windows(2)
        .map(|pair| {
            let [a, b] = [0, 1].map(|i| [pair[i][0] / pair[i][3], pair[i][1] / pair[i][3]]);
            (a[0] - b[0]).hypot(a[1] - b[1])
        })
        .sum();
    let count = ((polygon_m / SPACING_M).ceil() as usize).clamp(8, POINTS - 1);
    let points = (0..=count)
        .map(|index| {
            let u = from + (to - from) * index as f64 / count as f64;
            let [x, y, z, weight] = de_boor(&knots, &controls, order, u);
            [x / weight, y / weight, z / weight]
        })
        .collect();
    if is_timed {
        shape.note("times of control points are not used");
    }
    Ok(Line { points, times_s: None, is_closed: false })
}

/// The point of a B-spline at a parameter.
fn de_boor(knots: &[f64], controls: &[[f64; 4]], order: usize, u: f64) -> [f64; 4] {
    let degree = order - 1;
    let last = controls.len() - 1;
    // The span of the parameter; the end belongs to the last span that has a length.
    let span = (degree..=last)
        .rev()
        .find(|span| knots[*span] <= u && knots[*span] < knots[span + 1])
        .unwrap_or(degree);
    let mut points: Vec<[f64; 4]> = controls[span - degree..=span].to_vec();
    for level in 1..=degree {
        // From the back, so that `points[index - 1]` is still that of the level before.
        for index in (level..=degree).rev() {
            let knot = span - degree + index;
            let width = knots[knot + degree + 1 - level] - knots[knot];
            // A repeated knot makes a span without length, for which 0 / 0 counts as 0.
            let t = if width > 0.0 { (u - knots[knot]) / width } else { 0.0 };
            let before = points[index - 1];
            for (axis, value) in points[index].iter_mut().enumerate() {
                *value = (1.0 - t) * before[axis] + t * *value;
            }
        }
    }
    points[degree]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_quarter_circle_is_a_nurbs() {
        // The middle control point is (1, 1), with the cosine of 45° as its weight.
        let half = std::f64::consts::FRAC_1_SQRT_2;
        let controls = [[1.0, 0.0, 0.0, 1.0], [half, half, 0.0, half], [0.0, 1.0, 0.0, 1.0]];
        let knots = [0.0, 0.0, 0.0, 1.0, 1.0, 1.0];
        for u in [0.0, 0.2, 0.5, 0.9, 1.0] {
            let [x, y, _, weight] = de_boor(&knots, &controls, 3, u);
            assert!(((x / weight).hypot(y / weight) - 1.0).abs() < 1e-12, "{u}");
        }
        let [x, y, ..] = de_boor(&knots, &controls, 3, 1.0);
        assert!(x.abs() < 1e-12 && (y - 1.0).abs() < 1e-12);
    }
}
