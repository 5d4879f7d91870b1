//! Colors of floor, ceiling and walls, by position in meters.

use super::texture::{Color, fractal, hash2, noise, note, picture, wood};
use super::{Floor, Panel, PanelKind, Scene, Wallpaper};

impl Scene {
    pub(super) fn floor_color(&self, x: f64, y: f64) -> Color {
        let shell = &self.shell;
        let rug = &self.shell.rug;
        if inside([x, y], rug.low, rug.high) {
            // The rug has a border of 12 cm, and a diamond every 25 cm.
            let border = !inside(
                [x, y],
                rug.low.map(|v| v + 0.12),
                rug.high.map(|v| v - 0.12),
            );

            let diamond = ((x * 4.0).rem_euclid(1.0) - 0.5).abs()
                + ((y * 4.0).rem_euclid(1.0) - 0.5).abs()
                < 0.32;
            let color = rug.colors[usize::from(border || diamond)];

            return color.scaled(0.8 + 0.2 * noise(x * 50.0, y * 50.0, shell.seed));
        }

        match shell.floor {
            // Planks are 14 cm wide and 1.1 m long; rows are shifted, so that joints do not align.
            Floor::Planks(color) => {
                let plank = (y / 0.14).floor();
                let along = x + 0.9 * hash2(plank as i64, 1, shell.seed);
                let tone =
                    0.75 + 0.45 * hash2(plank as i64, (along / 1.1).floor() as i64, shell.seed);

                let seam =
                    (y / 0.14).rem_euclid(1.0) < 0.05 || (along / 1.1).rem_euclid(1.0) < 0.008;

                wood(color, along, y, shell.seed).scaled(if seam { 0.4 } else { tone })
            }
            Floor::Carpet(color) => {
                let weave = 0.8 + 0.2 * noise(x * 70.0, y * 70.0, shell.seed);
                color.scaled(weave * (0.85 + 0.3 * fractal(x * 1.5, y * 1.5, shell.seed ^ 3)))
            }

            // Tiles of 40 cm with individual tones, and gray joints.
            Floor::Tiles(color) => {
                let i = (x / 0.4).floor();
                let j = (y / 0.4).floor();
                let grout = (x / 0.4).rem_euclid(1.0) < 0.03 || (y / 0.4).rem_euclid(1.0) < 0.03;
                let tone = 0.7 + 0.3 * hash2(i as i64, j as i64, shell.seed);

                let cloud = 0.85 + 0.3 * fractal(x * 3.0, y * 3.0, shell.seed);
                if grout {
                    Color([0.25, 0.25, 0.25])
                } else {
                    color.scaled(tone * cloud)
                }
            }
        }
    }

    pub(super) fn ceiling_color(&self, x: f64, y: f64) -> (Color, f64) {
        // Above the lamp is a panel of 60 by 60 cm that emits light.
        let lamp = inside(
            [x, y],
            [self.lamp.x - 0.3, self.lamp.y - 0.3],
            [self.lamp.x + 0.3, self.lamp.y + 0.3],
        );

        let beam = (x / 1.3).rem_euclid(1.0) < 0.07;
        let color = Color::WHITE.scaled(if beam { 0.7 } else { 0.95 });

        (color, if lamp { self.light.panel } else { 0.0 })
    }

    pub(super) fn wall_color(&self, wall: usize, along: f64, up: f64) -> (Color, f64) {
        let shell = &self.shell;

        // From front to back: panels (door, window, pictures, notes), a skirting board of 10 cm,
        // the wall.
        let on = |panel: &&Panel| inside([along, up], panel.low, panel.high);
        if let Some(panel) = shell.panels[wall].iter().find(on) {
            let (color, glow) = panel_color(panel, along, up);
            return (color, glow * self.light.daylight);
        }
        if up < 0.1 {
            return (Color::WHITE.scaled(0.8), 0.0);
        }

        let plaster = 0.9 + 0.14 * fractal(along * 2.5, up * 2.5, shell.seed ^ wall as u32);
        let color = shell.wall_colors[wall].scaled(plaster);

        (
            shell
                .wallpaper
                .over(color, along, up, shell.seed ^ wall as u32),
            0.0,
        )
    }
}

impl Wallpaper {
    /// The wall's color with this pattern.
    fn over(self, color: Color, along: f64, up: f64, seed: u32) -> Color {
        match self {
            Self::None => color,
            Self::Stripes(apart) if (along / apart).rem_euclid(1.0) < 0.5 => color,
            Self::Stripes(_) => color.scaled(0.72),
            Self::Boards(height) if up > height + 0.04 => color,
            Self::Boards(height) if up > height => Color::WHITE.scaled(0.75),
            Self::Boards(_) => {
                let groove = (along / 0.12).rem_euclid(1.0) < 0.08;
                Color::WHITE.scaled(if groove { 0.45 } else { 0.7 })
            }

            // Bricks of 22 by 8 cm; every second row is shifted by half a brick.
            Self::Bricks => {
                let course = (up / 0.08).floor();
                let place = along / 0.22 + 0.5 * (course.rem_euclid(2.0));
                let mortar = (up / 0.08).rem_euclid(1.0) < 0.12 || place.rem_euclid(1.0) < 0.05;
                let tone = 0.65 + 0.5 * hash2(place.floor() as i64, course as i64, seed);

                if mortar {
                    Color::WHITE.scaled(0.55)
                } else {
                    color.mixed(Color([0.45, 0.2, 0.13]), 0.6).scaled(tone)
                }
            }
        }
    }
}

fn panel_color(panel: &Panel, along: f64, up: f64) -> (Color, f64) {
    // (u, v) are coordinates on the panel, meters from its low corner.
    let u = along - panel.low[0];
    let v = up - panel.low[1];

    let frame = if panel.kind == PanelKind::Door {
        0.07
    } else {
        0.04
    };
    let framed = !inside(
        [along, up],
        panel.low.map(|x| x + frame),
        panel.high.map(|x| x - frame),
    );

    match panel.kind {
        PanelKind::Note => (note(u, v, panel.seed), 0.0),
        PanelKind::Picture if framed => (Color([0.12, 0.09, 0.06]), 0.0),
        PanelKind::Picture => (picture(u, v, panel.seed), 0.0),
        PanelKind::Window => {
            let middle = (panel.high[0] - panel.low[0]) / 2.0;
            if framed || (u - middle).abs() < 0.03 {
                return (Color::WHITE, 0.2);
            }

            // The view through the window: hills below a wavy line, and a sky that is paler toward
            // the horizon.
            let height = v / (panel.high[1] - panel.low[1]);
            let hills = 0.35 + 0.2 * fractal(u * 2.0, 0.0, panel.seed);
            if height < hills {
                (
                    Color([0.2, 0.38, 0.15])
                        .scaled(0.6 + 0.8 * noise(u * 9.0, v * 9.0, panel.seed)),
                    0.6,
                )
            } else {
                (
                    Color([0.55, 0.7, 0.9]).mixed(Color([0.9, 0.93, 0.95]), 1.0 - height),
                    0.9,
                )
            }
        }
        PanelKind::Door if framed => (Color::WHITE.scaled(0.75), 0.0),
        PanelKind::Door => {
            // A door is 0.9 m wide, with a handle near one edge and two darker fields.
            let handle = (u - 0.75).abs() < 0.05 && (v - 1.0).abs() < 0.03;
            let fill =
                (0.2..0.7).contains(&u) && ((0.25..0.9).contains(&v) || (1.1..1.8).contains(&v));
            let timber = Color::of_hue(0.07, 0.5, if fill { 0.38 } else { 0.5 });

            (
                if handle {
                    Color([0.7, 0.65, 0.4])
                } else {
                    wood(timber, v, u, panel.seed)
                },
                0.0,
            )
        }
    }
}

fn inside(point: [f64; 2], low: [f64; 2], high: [f64; 2]) -> bool {
    (0..2).all(|c| point[c] >= low[c] && point[c] <= high[c])
}
