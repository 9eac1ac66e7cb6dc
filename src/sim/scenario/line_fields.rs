//! The fields of sections that name a line to follow. They stand here once: a section within a
//! section, whose fields serde would flatten, accepts unknown fields.

/// A section that names a line to follow, with fields of its own.
macro_rules! section_on_line {
    ($(#[$attribute:meta])* pub struct $name:ident { $($fields:tt)* }) => {
        $(#[$attribute])*
        pub struct $name {
            /// A recorded trajectory of the twin, as the line to follow. Exactly one of `along`,
            /// `points` and `lanes`.
            #[serde(skip_serializing_if = "Option::is_none")]
            pub along: Option<String>,
            /// Points in the world, in metres, in order. They are placed on the ground where there
            /// is one.
            #[serde(skip_serializing_if = "Option::is_none")]
            pub points: Option<Vec<[f64; 3]>>,
            /// Lanes of the map, in order.
            #[serde(skip_serializing_if = "Option::is_none")]
            pub lanes: Option<Vec<String>>,
            /// Whether to follow it from its end to its start. If absent, false.
            #[serde(skip_serializing_if = "Option::is_none")]
            pub reverse: Option<bool>,
            $($fields)*
        }
    };
}

/// A section that names a line to follow, and where and how fast an actor starts on it, with fields
/// of its own.
macro_rules! section_on_course {
    ($(#[$attribute:meta])* pub struct $name:ident { $($fields:tt)* }) => {
        $crate::scenario::line_fields::section_on_line! {
            $(#[$attribute])*
            pub struct $name {
                /// Where it starts, in metres along the line.
                pub station_m: f64,
                /// Its offset to the left of the line, in metres. If absent, 0.
                #[serde(skip_serializing_if = "Option::is_none")]
                pub offset_m: Option<f64>,
                /// Its speed at the start, in m/s.
                pub speed: f64,
                /// Whether it disappears at the end of the line. Otherwise it stands there.
                #[serde(skip_serializing_if = "Option::is_none")]
                pub leaves: Option<bool>,
                $($fields)*
            }
        }
    };
}

pub(super) use {section_on_course, section_on_line};
