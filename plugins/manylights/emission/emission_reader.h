#pragma once

/**
 * Emission that is constant over an emitter, as the rows of the light table hold it: three
 * numbers in RGB and monochrome variants, D65 times an upsampled colour in spectral ones.
 */

#include "emission.h"
#include "manylights/base/device_scalars.h"
#include "manylights/base/host_view.h"
#include "manylights/base/loop.h"
#include "manylights/base/parameter_reader.h"
#include <cmath>
#include <cstring>
#include <mitsuba/core/spectrum.h>
#include <mitsuba/render/interaction.h>
#include <mitsuba/render/texture.h>
#include <vector>

namespace manylights {

namespace dr = drjit;

/// Values of variables that have one entry each
template <typename Float, size_t Count>
void read_scalars(const Float *const (&values)[Count], float (&out)[Count]) {
    if constexpr (dr::is_llvm_v<Float>) {
        // jit_var_read copies in a task of its own. All addresses before the first value:
        // the processor then waits for the memory of all of them at once
        VarInfo info[Count];
        bool evaluated = true;
        for (size_t i = 0; i < Count; ++i) {
            info[i] = jit_set_backend(values[i]->index());
            evaluated &= info[i].state == VarState::Evaluated;
        }
        if (evaluated) {
            dr::sync_thread();
            for (size_t i = 0; i < Count; ++i)
                out[i] = (float) *(const dr::scalar_t<Float> *) info[i].data;
            return;
        }
    }
    for (size_t i = 0; i < Count; ++i) {
        if constexpr (dr::is_jit_v<Float>) {
            if (auto *known = DeviceScalars<Float>::find(values[i]->index())) {
                out[i] = *known;
                continue;
            }
            dr::scalar_t<Float> number;
            jit_var_read(values[i]->index(), 0, &number);
            out[i] = (float) number;
        } else {
            out[i] = (float) *values[i];
        }
    }
}

template <typename Float> float read_scalar(const Float &value) {
    float result[1];
    read_scalars<Float, 1>({ &value }, result);
    return result[0];
}

/// Names of the textures that make emitters shine
constexpr std::string_view kEmissionNames[] = { "intensity", "radiance", "irradiance" };

/// Is any number of an object, or of what it consists of, differentiated?
template <typename Float> bool has_gradient(const mitsuba::Object *object) {
    bool found = false;
    if constexpr (dr::is_diff_v<Float>) {
        dr::scoped_set_flag guard(JitFlag::EnableObjectTraversal, true);
        auto look = [](void *result, uint64_t index, const char *, const char *) {
            *(bool *) result |= (index >> 32) != 0; // number of the AD variable
        };
        object->traverse_1_cb_ro(&found, look);
    }
    return found;
}

/// Is any of a mesh's attributes (`face_color`, `vertex_color`...) differentiated?
template <typename Float> bool attributes_have_gradient(const mitsuba::Object *mesh) {
    using Values = mitsuba::DynamicBuffer<dr::replace_scalar_t<Float, float>>;
    struct Visitor : mitsuba::TraversalCallback {
        bool found = false;
        void put_value(std::string_view name, void *value, uint32_t,
                       const std::type_info &type) override {
            bool geometry = name == "vertex_positions" || name == "vertex_normals" ||
                            name == "vertex_texcoords",
                 attribute =
                     name.substr(0, 7) == "vertex_" || name.substr(0, 5) == "face_";
            if (attribute && !geometry && type == typeid(Values))
                found |= dr::grad_enabled(*(const Values *) value);
        }
        void put_object(std::string_view, mitsuba::Object *, uint32_t) override {}
    } visitor;
    if constexpr (dr::is_diff_v<Float>)
        const_cast<mitsuba::Object *>(mesh)->traverse(&visitor);
    return visitor.found;
}

/// Does what an emitter emits, or an attribute of the mesh that it belongs to (null if none),
/// have a gradient? The table then cannot stand for it: its numbers have no derivative.
template <typename Float>
bool emission_has_gradient(const mitsuba::Object *emitter, const mitsuba::Object *mesh) {
    if constexpr (dr::is_diff_v<Float>) {
        ParameterReader params(emitter);
        for (std::string_view name : kEmissionNames)
            if (const mitsuba::Object *texture = params.object(name);
                texture && has_gradient<Float>(texture))
                return true;
        return mesh && attributes_have_gradient<Float>(mesh);
    }
    return false;
}

template <typename Float, typename Spectrum> struct EmissionReader {
    /// Radiance, intensity or irradiance of an emitter; not tabulated if it has none of these
    static Emission read(const mitsuba::Object *emitter) {
        ParameterReader params(emitter);
        for (std::string_view name : kEmissionNames)
            if (params.object(name))
                return read(params, std::string(name));
        return {};
    }

    /// Emission from the texture `name`; not tabulated if it varies, is differentiated, or has a
    /// spectrum that rows cannot hold
    static Emission read(const ParameterReader &params, const std::string &name) {
        Emission e;
        const mitsuba::Object *texture = params.object(name);
        std::string_view type = texture ? texture->class_name() : std::string_view();
        using Color =
            mitsuba::Color<Float, mitsuba::is_monochromatic_v<Spectrum> ? 1 : 3>;
        const Color *color = params.find<Color>(name + ".value");
        if constexpr (mitsuba::is_spectral_v<Spectrum>) {
            using Values = mitsuba::DynamicBuffer<Float>;
            bool regular = type == "RegularSpectrum";
            const Values *d65 =
                params.find<Values>(name + (regular ? ".values" : ".d65.values"));
            bool has_color = type == "D65Spectrum" && color;
            if (d65 && (has_color || (regular && is_d65(*d65)))) {
                e.scale    = scale_of_d65(*d65);
                e.color[2] = std::numeric_limits<float>::infinity(); // sigmoid of 1
                if (has_color)
                    read_color(*color, e.color);
                e.brightness = spectral_mean(e);
                e.tabulated  = true;
            }
        } else {
            if (type == "SRGBReflectanceSpectrum" && color) {
                read_color(*color, e.color);
                e.tabulated = true;
            } else if (const Float *value = params.find<Float>(name + ".value");
                       type == "UniformSpectrum" && value) {
                std::fill_n(e.color, 3, read_scalar(*value));
                e.tabulated = true;
            }
            e.brightness = brightness(e.color);
        }
        e.constant = e.tabulated;
        if (!texture)
            return e;
        if constexpr (mitsuba::is_spectral_v<Spectrum>)
            if (!e.tabulated)
                read_spectrum(texture, e);
        // A value in the table has no derivative: let the emitter evaluate it instead
        if (e.tabulated && has_gradient<Float>(texture))
            e.tabulated = false;
        return e;
    }

    /**
     * Root mean square of the channels, negative if they are: what the error of a colour image
     * is measured by. The luminance would choose blue and purple lights too seldom.
     */
    static float brightness(const float color[3]) {
        if constexpr (mitsuba::is_monochromatic_v<Spectrum>)
            return color[0];
        // Doubles hold the squares of all floats
        double sum     = (double) color[0] + color[1] + color[2],
               squares = (double) color[0] * color[0] + (double) color[1] * color[1] +
                         (double) color[2] * color[2];
        return (float) std::copysign(std::sqrt(squares / 3), sum);
    }

private:
    using Texture = mitsuba::Texture<Float, Spectrum>;

    /// Brightness of a spectrum that rows cannot hold
    static void read_spectrum(const mitsuba::Object *object, Emission &e) {
        auto *texture = dynamic_cast<const Texture *>(object);
        if (texture && is_spectrum(object)) {
            e.brightness = mean_over_wavelengths(texture);
            e.constant   = true;
        }
    }

    /// Does it depend on nothing but the wavelength? Mesh attributes deny that they vary in
    /// space, so textures are not asked
    static bool is_spectrum(const mitsuba::Object *texture) {
        std::string_view type = texture->class_name();
        if (type == "D65Spectrum") {
            auto *nested = ParameterReader(texture).object("nested_texture");
            return !nested || is_spectrum(nested);
        }
        return type == "UniformSpectrum" || type == "RegularSpectrum" ||
               type == "IrregularSpectrum" || type == "BlackBodySpectrum" ||
               type == "SRGBReflectanceSpectrum";
    }

    /// Mean over the visible range; exact for tabulated spectra, which may be narrow lines
    static float mean_over_wavelengths(const Texture *texture) {
        using Values          = mitsuba::DynamicBuffer<Float>;
        std::string_view type = texture->class_name();
        ParameterReader params(texture);
        if (type == "UniformSpectrum")
            if (const Float *value = params.find<Float>("value"))
                return read_scalar(*value);
        const Values *values = params.find<Values>("values");
        if (type == "IrregularSpectrum" && values)
            if (const Values *nodes = params.find<Values>("wavelengths"))
                return mean_of_line(HostView(*nodes), HostView(*values));
        if (type == "RegularSpectrum" && values) {
            auto range   = texture->wavelength_range();
            size_t count = dr::width(*values);
            std::vector<double> nodes(count);
            for (size_t i = 0; i < count; ++i)
                nodes[i] = range.x() + (range.y() - range.x()) * i / (count - 1.);
            return mean_of_line(nodes, HostView(*values));
        }
        return mean_of_samples(texture);
    }

    /// Mean over the visible range of the line through points, 0 beyond them
    template <typename Nodes, typename Values>
    static float mean_of_line(const Nodes &nodes, const Values &values) {
        double sum = 0;
        for (size_t i = 0; i + 1 < values.size(); ++i) {
            double a = nodes[i], b = nodes[i + 1], low = std::max(a, (double) MI_CIE_MIN),
                   high = std::min(b, (double) MI_CIE_MAX), middle = .5 * (low + high);
            if (low < high)
                sum += (high - low) *
                       (values[i] + (values[i + 1] - values[i]) * (middle - a) / (b - a));
        }
        return (float) (sum / (MI_CIE_MAX - MI_CIE_MIN));
    }

    /// The same from samples that are a quarter of a nanometre apart; what falls between them
    /// may be a line of that width
    static float mean_of_samples(const Texture *texture) {
        auto si = dr::zeros<mitsuba::SurfaceInteraction<Float, Spectrum>>();
        constexpr size_t lanes = dr::size_v<decltype(si.wavelengths)>,
                         count = 1880 / lanes;
        auto mean_at           = [&](const auto &i) {
            for (size_t k = 0; k < lanes; ++k)
                si.wavelengths.entry(k) = dr::fmadd(
                    Float(i) + (float) ((k + .5) / lanes),
                    (float) ((MI_CIE_MAX - MI_CIE_MIN) / count), (float) MI_CIE_MIN);
            return dr::mean(texture->eval(si, true));
        };
        double sum = 0;
        if constexpr (dr::is_jit_v<Float>) {
            Float values = mean_at(dr::arange<dr::uint32_array_t<Float>>(count));
            sum          = read_scalar(dr::sum(values + dr::zeros<Float>(count)));
        } else {
            for (uint32_t i = 0; i < count; ++i)
                sum += mean_at(i);
        }
        return (float) ((sum == 0 ? (double) texture->max() / lanes : sum) / count);
    }

    template <typename Color> static void read_color(const Color &color, float out[3]) {
        if constexpr (dr::size_v<Color> == 3) {
            float values[3];
            read_scalars({ &color.entry(0), &color.entry(1), &color.entry(2) }, values);
            std::copy_n(values, 3, out);
        } else {
            out[0] = read_scalar(color.entry(0));
        }
    }

    static float d65_value(size_t i) {
        return (float) (mitsuba::d65_table[i] * MI_CIE_D65_NORMALIZATION);
    }

    template <typename Values> static float scale_of_d65(const Values &values) {
        return (float) dr::slice(values, 0) / d65_value(0);
    }

    template <typename Values> static bool is_d65(const Values &values) {
        HostView host(values);
        if (host.size() != MI_CIE_SAMPLES)
            return false;
        float scale = (float) host[0] / d65_value(0);
        for (size_t i = 1; i < MI_CIE_SAMPLES; ++i) {
            float expected = scale * d65_value(i);
            if (std::abs((float) host[i] - expected) > 1e-5f * expected)
                return false;
        }
        return true;
    }

    /// Mean of scale * D65 * S over the visible range (the stage-3 target's brightness)
    static float spectral_mean(const Emission &e) {
        double sum = 0;
        for (size_t i = 0; i < MI_CIE_SAMPLES; ++i) {
            double w =
                MI_CIE_MIN + (MI_CIE_MAX - MI_CIE_MIN) * i / (MI_CIE_SAMPLES - 1.0);
            double v = (e.color[0] * w + e.color[1]) * w + e.color[2],
                   s = std::isinf(v) ? (v > 0 ? 1 : 0)
                                     : .5 + .5 * v / std::sqrt(1 + v * v);
            sum += d65_value(i) * s;
        }
        return (float) (e.scale * sum / MI_CIE_SAMPLES);
    }
};

} // namespace manylights
