#pragma once

/**
 * A perspective camera, with or without a lens, as a closed form: where a point of the scene is on
 * the film, and how densely camera rays go there.
 */

#include "manylights/base/parameter_reader.h"
#include "manylights/base/recording.h"
#include "manylights/emission/emission_reader.h"
#include <mitsuba/core/vector.h>
#include <mitsuba/core/warp.h>
#include <mitsuba/render/film.h>
#include <mitsuba/render/sensor.h>

namespace manylights {

template <typename Float> struct CameraView {
    using Mask     = dr::mask_t<Float>;
    using Vector2f = mitsuba::Vector<Float, 2>;
    using Vector3f = mitsuba::Vector<Float, 3>;
    using Point2f  = mitsuba::Point<Float, 2>;
    using Point3f  = mitsuba::Point<Float, 3>;

    /// The pinhole or the middle of the lens, and the camera's axes; it looks along the last
    Point3f position;
    Vector3f axes[3];
    /// Pixels for a unit of length at the distance 1, and the pixel that is looked at, in relation
    /// to the first one of the crop window
    Vector2f scale, shift;
    /// Of the lens; its radius is 0 for a pinhole
    Float radius, inverse_focus;
    Float near_clip, far_clip;

    /// Depth of a point, along the camera's axis
    Float depth(const Point3f &p) const { return dr::dot(p - position, axes[2]); }

    /// Pixels for a unit of area at the depth 1
    Float pixels() const { return dr::abs(scale.x() * scale.y()); }

    /// Camera rays for a unit of solid angle in the direction d, from a point of the lens, with
    /// one ray for each pixel
    Float density(const Vector3f &d) const {
        Float cosine = dr::dot(d, axes[2]);
        return pixels() / (cosine * cosine * cosine);
    }

    Point3f lens_point(const Point2f &u) const {
        if (!has_lens())
            return position;
        auto disk = mitsuba::warp::square_to_uniform_disk_concentric(u);
        return position + radius * (disk.x() * axes[0] + disk.y() * axes[1]);
    }

    /// The point of the lens that a camera ray along d through p has come from
    Point3f lens_point(const Point3f &p, const Vector3f &d) const {
        if (!has_lens())
            return position;
        return p - d * (depth(p) / dr::dot(d, axes[2]));
    }

    /// Where p is on the film, seen from a point of the lens, in pixels from the first one of
    /// the crop window
    Point2f on_film(const Point3f &p, const Point3f &from) const {
        Vector3f w = p - position, a = from - position;
        Float inverse = dr::rcp(dr::dot(w, axes[2]));
        Vector2f tangent(dr::dot(w, axes[0]), dr::dot(w, axes[1])),
            on_lens(dr::dot(a, axes[0]), dr::dot(a, axes[1]));
        return Point2f(scale * (tangent * inverse + on_lens * (inverse_focus - inverse)) +
                       shift);
    }

    bool has_lens() const { return lens; }

    /// On the host
    bool operator==(const CameraView &other) const {
        bool same = lens == other.lens && radius == other.radius &&
                    inverse_focus == other.inverse_focus &&
                    near_clip == other.near_clip && far_clip == other.far_clip &&
                    dr::all(position == other.position) &&
                    dr::all(scale == other.scale) && dr::all(shift == other.shift);
        for (size_t i = 0; i < 3; ++i)
            same &= dr::all(axes[i] == other.axes[i]);
        return same;
    }

    /// The same numbers for kernels that do not depend on them
    template <typename Value> CameraView<Value> opaque() const {
        CameraView<Value> result;
        auto copy = [](auto &to, const auto &from) {
            for (size_t i = 0; i < from.size(); ++i)
                to.entry(i) = dr::opaque<Value>(from.entry(i));
        };
        copy(result.position, position);
        for (size_t i = 0; i < 3; ++i)
            copy(result.axes[i], axes[i]);
        copy(result.scale, scale);
        copy(result.shift, shift);
        result.radius        = dr::opaque<Value>(radius);
        result.inverse_focus = dr::opaque<Value>(inverse_focus);
        result.near_clip     = dr::opaque<Value>(near_clip);
        result.far_clip      = dr::opaque<Value>(far_clip);
        result.lens          = lens;
        return result;
    }

    MANYLIGHTS_TRAVERSE(position, axes, scale, shift, radius, inverse_focus, near_clip,
                        far_clip)

    bool lens = false;
};

/// Is it a camera whose view is known?
template <typename Sensor> bool has_view(const Sensor *sensor) {
    std::string_view name = sensor->class_name();
    return name == "PerspectiveCamera" || name == "ThinLensCamera";
}

/// The view of such a camera, on the host
template <typename Float, typename Spectrum>
CameraView<float> read_view(const mitsuba::Sensor<Float, Spectrum> *sensor) {
    auto *camera = (const mitsuba::ProjectiveCamera<Float, Spectrum> *) sensor;
    ParameterReader params(sensor);
    auto number = [&](const char *name) {
        const Float *value = params.find<Float>(name);
        return value ? read_scalar(*value) : 0.f;
    };
    CameraView<float> view;
    auto to_world = sensor->world_transform();
    auto size     = sensor->film()->size();
    auto offset   = sensor->film()->crop_offset();
    // Mitsuba's projection is not evaluated: reading it would take kernels
    float tangent = std::tan(.5f * dr::deg_to_rad(number("x_fov")));
    for (size_t i = 0; i < 3; ++i) {
        view.position.entry(i) = read_scalar(to_world.matrix.entry(i, 3));
        for (size_t j = 0; j < 3; ++j)
            view.axes[j].entry(i) = read_scalar(to_world.matrix.entry(i, j));
    }
    const char *offsets[] = { "principal_point_offset_x", "principal_point_offset_y" };
    for (size_t i = 0; i < 2; ++i) {
        view.scale.entry(i) = -.5f * (float) size.x() / tangent;
        view.shift.entry(i) =
            (float) size[i] * (.5f - number(offsets[i])) - (float) offset[i];
    }
    view.lens          = sensor->class_name() == "ThinLensCamera";
    view.radius        = view.lens ? number("aperture_radius") : 0.f;
    view.inverse_focus = view.lens ? 1.f / number("focus_distance") : 0.f;
    view.near_clip     = (float) camera->near_clip();
    view.far_clip      = (float) camera->far_clip();
    return view;
}

} // namespace manylights
