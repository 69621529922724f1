//! What a 3D run is measured by and leaves to look at, on the host in f64: poses against a reference, pictures against
//! photos, meshes, exports and tables in the papers' layout. Nothing here needs a trainer or a loader; poses are
//! [`Pose`](crate::geometry::Pose)s, pictures lists of colours.
//!
//! Of the same quantity the published programs compute more than one version; each function says whose it is.

mod align;
mod camera_plot;
mod chamfer;
mod depth_pictures;
mod export;
mod image_metrics;
mod lpips;
mod mesh;
mod mesh_files;
mod mesh_reader;
mod novel_path;
mod pose_error;
mod published;
mod scores;
mod table;
mod table_files;
mod video;

pub use align::{Alignment, PoseSetError, Similarity, pairwise, procrustes, umeyama};
pub use camera_plot::{CameraLayout, CameraPanel, CameraPlotError, camera_plot};
pub use chamfer::{Chamfer, CloudError, chamfer};
pub use depth_pictures::{DepthStyle, inverse_depth};
pub use export::{Colmap, ExportCamera, ExportError, poses_bounds, transforms_json};
pub use image_metrics::{DepthErrors, ImageError, Picture, depth_errors, mse, psnr, released_depth_errors, ssim};
pub use lpips::{Lpips, WeightsError};
pub use mesh::{DensityError, Mesh, MeshError, MeshOptions};
pub use mesh_reader::MeshFileError;
pub use novel_path::{FRAMES, anchor, novel_view_path};
pub use pose_error::{PoseErrors, common_turn, pose_errors, rotation_angle};
pub use published::{PublishedRow, PublishedTable, published, published_for, published_of};
pub use scores::{Evaluation, FoundLens, Measured, Metric, Scores, Stage, ViewScores, success_px};
pub use table::{Cell, Row, Table};
pub use video::{Video, VideoError, write_video, write_video_with};
