#pragma once

/// Which participating media a scene has: code for others is not even recorded.

#include "manylights/base/loop.h"
#include "manylights/emission/emission_reader.h"
#include "scene_shapes.h"
#include <mitsuba/render/medium.h>
#include <mitsuba/render/scene.h>
#include <mitsuba/render/sensor.h>
#include <mitsuba/render/volume.h>

namespace manylights {

struct MediaKinds {
    bool any = false, homogeneous = false, heterogeneous = false;
    /// Does the extinction of any vary with the wavelength? Its majorant, too?
    bool chromatic = false, chromatic_majorants = false;
    /// Do homogeneous ones scatter?
    bool scattering = false;
    /// Do any surfaces let light pass straight on?
    bool borders = false;

    uint32_t bits() const {
        return any + 2 * homogeneous + 4 * heterogeneous + 8 * chromatic +
               16 * scattering + 32 * chromatic_majorants + 64 * borders;
    }
};

/// Reads of a medium what decides which code its scene needs; "may" where it cannot be known
template <typename Float, typename Spectrum> struct MediumReader {
    using Medium = mitsuba::Medium<Float, Spectrum>;
    using Scene  = mitsuba::Scene<Float, Spectrum>;
    using Volume = mitsuba::Volume<Float, Spectrum>;
    using Color  = mitsuba::Color<Float, mitsuba::is_monochromatic_v<Spectrum> ? 1 : 3>;

    /// The media of the scene's shapes, within groups, too, and of its sensors
    static MediaKinds find(const Scene *scene) {
        MediaKinds kinds;
        for_each_shape(scene, [&](const auto *shape) {
            add(kinds, shape->interior_medium());
            add(kinds, shape->exterior_medium());
            kinds.borders |= has_flag(shape->bsdf()->flags(), mitsuba::BSDFFlags::Null);
        });
        for (const auto &sensor : scene->sensors())
            add(kinds, sensor->medium());
        // Shadow rays pass them with or without media
        kinds.any |= kinds.borders;
        return kinds;
    }

    /// The same with the medium that a caller of `sample()` starts in
    static MediaKinds with(MediaKinds kinds, const Scene *scene, const Medium *medium) {
        bool known = !medium;
        for (const auto &sensor : scene->sensors())
            known |= sensor->medium() == medium;
        if (!known)
            add(kinds, medium);
        return kinds;
    }

    static void add(MediaKinds &kinds, const Medium *medium) {
        if (!medium)
            return;
        kinds.any        = true;
        bool homogeneous = medium->is_homogeneous();
        (homogeneous ? kinds.homogeneous : kinds.heterogeneous) = true;
        bool chromatic = may_be_chromatic(medium);
        kinds.chromatic |= chromatic;
        // The majorant of Mitsuba's heterogeneous media is a single number
        kinds.chromatic_majorants |=
            chromatic && medium->class_name() != "HeterogeneousMedium";
        if (homogeneous && !kinds.scattering)
            kinds.scattering = may_scatter(medium);
    }

    static bool may_scatter(const Medium *medium) {
        constexpr std::string_view name = "albedo.value.value";
        ParameterReader params(medium);
        const Float *value = params.find<Float>(name);
        const Color *color = params.find<Color>(name);
        if ((value && has_derivatives(*value)) || (color && has_derivatives(*color)))
            return true;
        float albedo[3];
        return !read(medium, name, albedo) || albedo[0] != 0 || albedo[1] != 0 ||
               albedo[2] != 0;
    }

    static bool may_be_chromatic(const Medium *medium) {
        if constexpr (mitsuba::is_monochromatic_v<Spectrum>)
            return false;
        auto *grid =
            dynamic_cast<const Volume *>(ParameterReader(medium).object("sigma_t"));
        if (grid && grid->class_name() == "GridVolume" && grid->channel_count() == 1)
            return false;
        float sigma[3];
        return !read(medium, "sigma_t.value.value", sigma) || sigma[0] != sigma[1] ||
               sigma[0] != sigma[2];
    }

private:
    /// A constant coefficient; false if it is none (then "may" it is)
    static bool read(const Medium *medium, std::string_view name, float out[3]) {
        ParameterReader params(medium);
        if (const Float *value = params.find<Float>(name)) {
            std::fill_n(out, 3, read_scalar(*value));
            return true;
        }
        // In spectral variants the parameters of an upsampled colour tell nothing at a glance
        const Color *color =
            mitsuba::is_spectral_v<Spectrum> ? nullptr : params.find<Color>(name);
        for (size_t i = 0; color && i < 3; ++i)
            out[i] = read_scalar(color->entry(i % dr::size_v<Color>));
        return color != nullptr;
    }
};

} // namespace manylights
