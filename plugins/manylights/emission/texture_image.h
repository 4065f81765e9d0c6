#pragma once

/**
 * The brightness of a bitmap that emits, as a map of its texels: read once for all lights that
 * show it. What is stored (bytes, sRGB, coefficients of spectra) is the texture's own matter:
 * it is asked for its value at each texel.
 */

#include "brightness_map.h"
#include "manylights/base/host_memory.h"
#include "surface_emission.h"
#include <memory>
#include <mitsuba/render/texture.h>
#include <optional>
#include <unordered_map>

namespace manylights {

template <typename Float, typename Spectrum> class TextureImage {
public:
    MI_IMPORT_TYPES(Texture)

    /// Null if `radiance` is no bitmap, or one with values that are no brightness
    static std::unique_ptr<TextureImage> read(const mitsuba::Object *radiance) {
        const auto *texture = dynamic_cast<const Texture *>(radiance);
        ParameterReader params(radiance);
        const mitsuba::Object *bitmap = radiance;
        if (texture && !is_bitmap(bitmap))
            bitmap = params.object("nested_texture"); // of D65
        if (!texture || !bitmap || !is_bitmap(bitmap))
            return nullptr;
        std::unique_ptr<TextureImage> image(new TextureImage(texture));
        return image->read_to_uv(bitmap) && image->read_map(bitmap) ? std::move(image)
                                                                    : nullptr;
    }

    /// Mean brightness over a triangle or convex quadrilateral of texture coordinates;
    /// positive if the texture is anywhere on it
    float mean(const Point2 *uv, size_t count) const {
        Point2 corners[4];
        for (size_t i = 0; i < count; ++i)
            for (int k = 0; k < 2; ++k)
                corners[i][k] =
                    m_to_uv[k][0] * uv[i][0] + m_to_uv[k][1] * uv[i][1] + m_to_uv[k][2];
        return m_map->mean(corners, count) + m_least;
    }

    /// Mean over a rectangle of texture coordinates
    float mean(double u0, double v0, double u1, double v1) const {
        Point2 corners[4] = { { u0, v0 }, { u1, v0 }, { u1, v1 }, { u0, v1 } };
        return mean(corners, 4);
    }

private:
    using Reader = EmissionReader<Float, Spectrum>;
    /// Larger bitmaps are looked up at so many places, evenly spread
    static constexpr size_t kMostTexels = 1 << 22;

    explicit TextureImage(const Texture *texture) : m_texture(texture) {}

    static bool is_bitmap(const mitsuba::Object *object) {
        return object->class_name().substr(0, 17) == "BitmapTextureImpl";
    }

    bool read_to_uv(const mitsuba::Object *bitmap) {
        using Transform =
            typename mitsuba::CoreAliases<dr::scalar_t<Float>>::AffineTransform3f;
        const auto *to_uv = ParameterReader(bitmap).find<Transform>("to_uv");
        if (!to_uv)
            return false;
        for (size_t i = 0; i < 2; ++i)
            for (size_t j = 0; j < 3; ++j)
                m_to_uv[i][j] = (double) to_uv->matrix.entry(i, j);
        double determinant =
            m_to_uv[0][0] * m_to_uv[1][1] - m_to_uv[0][1] * m_to_uv[1][0];
        m_inverse = 1 / determinant;
        return std::isfinite(m_inverse);
    }

    /// Texture coordinates of a point of the plane that the bitmap covers
    Point2 to_texture(double x, double y) const {
        x -= m_to_uv[0][2];
        y -= m_to_uv[1][2];
        return { m_inverse * (m_to_uv[1][1] * x - m_to_uv[0][1] * y),
                 m_inverse * (m_to_uv[0][0] * y - m_to_uv[1][0] * x) };
    }

    bool read_map(const mitsuba::Object *bitmap) {
        auto size     = dynamic_cast<const Texture *>(bitmap)->resolution();
        double stride = std::ceil(
            std::sqrt((double) size.x() * (double) size.y() / (double) kMostTexels));
        size_t width              = (size_t) std::ceil(size.x() / stride),
               height             = (size_t) std::ceil(size.y() / stride);
        std::vector<float> texels = evaluate(width * height, [&](size_t i) {
            return to_texture(((double) (i % width) + .5) / (double) width,
                              ((double) (i / width) + .5) / (double) height);
        });
        if (!std::all_of(texels.begin(), texels.end(),
                         [](float value) { return std::isfinite(value) && value >= 0; }))
            return false;
        m_map.emplace(width, height, texels, find_wrap(texels, width, height));
        // Between these places there may be others
        if (stride > 1)
            m_least = std::max(read_scalar(Float(m_texture->mean())), m_map->mean()) / 64;
        return true;
    }

    /// Brightness at `count` points: texture coordinates uv(i)
    template <typename F> std::vector<float> evaluate(size_t count, const F &uv) const {
        std::vector<float> result(count);
        if constexpr (dr::is_jit_v<Float>) {
            dr::suspend_grad<Float> detached;
            std::vector<float> u(count), v(count);
            for (size_t i = 0; i < count; ++i) {
                Point2 point = uv(i);
                u[i]         = (float) point[0];
                v[i]         = (float) point[1];
            }
            auto colors =
                colors_on_host<Float>(color(Point2f(dr::load<Float>(u.data(), count),
                                                    dr::load<Float>(v.data(), count))),
                                      count);
            for (size_t i = 0; i < count; ++i)
                result[i] = Reader::brightness(colors[i].data());
        } else {
            for_chunks(count, [&](size_t, size_t begin, size_t end) {
                for (size_t i = begin; i < end; ++i) {
                    Point2 point  = uv(i);
                    Color3f value = color(Point2f((float) point[0], (float) point[1]));
                    float rgb[3]  = { value[0], value[1], value[2] };
                    result[i]     = Reader::brightness(rgb);
                }
            });
        }
        return result;
    }

    Color3f color(const Point2f &uv) const {
        SurfaceInteraction3f si = dr::zeros<SurfaceInteraction3f>();
        si.uv                   = uv;
        auto eval               = [&] { return m_texture->eval(si, true); };
        if constexpr (mitsuba::is_spectral_v<Spectrum>)
            return Color3f(mean_over_wavelengths<Float>(si, 8, eval)); // they are smooth
        else if constexpr (mitsuba::is_rgb_v<Spectrum>)
            return eval();
        else
            return Color3f(dr::mean(eval()));
    }

    /// The texture does not tell how it goes on: look where the ways differ most
    Wrap find_wrap(const std::vector<float> &texels, size_t width, size_t height) const {
        constexpr Wrap modes[] = { Wrap::Repeat, Wrap::Mirror, Wrap::Clamp };
        struct Probe {
            double x, y;
            float expected[3];
        };
        std::vector<Probe> probes;
        for (bool down : { false, true }) {
            float most[3] = { 0, 0, 0 };
            Probe best[3];
            for (size_t i = 0; i < texels.size(); ++i) {
                size_t x = i % width, y = i / width;
                Probe probe{ (double) x + .5, (double) y + .5, {} };
                (down ? probe.y : probe.x) += (double) (down ? height : width);
                for (int m = 0; m < 3; ++m) {
                    size_t there = BrightnessMap::next_period(modes[m], down ? y : x,
                                                              down ? height : width);
                    probe.expected[m] =
                        texels[down ? there * width + x : y * width + there];
                }
                for (int m = 0; m < 3; ++m)
                    if (float difference =
                            std::abs(probe.expected[m] - probe.expected[(m + 1) % 3]);
                        difference > most[m]) {
                        most[m] = difference;
                        best[m] = probe;
                    }
            }
            for (int m = 0; m < 3; ++m)
                if (most[m] > 0)
                    probes.push_back(best[m]);
        }
        if (probes.empty()) // of one colour
            return Wrap::Repeat;
        std::vector<float> values = evaluate(probes.size(), [&](size_t i) {
            return to_texture(probes[i].x / (double) width,
                              probes[i].y / (double) height);
        });
        double error[3]           = { 0, 0, 0 };
        for (size_t i = 0; i < probes.size(); ++i)
            for (int m = 0; m < 3; ++m)
                error[m] += std::abs(values[i] - probes[i].expected[m]);
        return modes[std::min_element(error, error + 3) - error];
    }

    const Texture *m_texture;
    double m_to_uv[2][3], m_inverse;
    std::optional<BrightnessMap> m_map;
    float m_least = 0;
};

/// The bitmaps that emitters show, each read at first use
template <typename Float, typename Spectrum> class ShownImages {
public:
    MI_IMPORT_TYPES(Emitter)
    using Image = TextureImage<Float, Spectrum>;

    /// The one that makes an emitter shine; null if it is something else
    const Image *of(const Emitter *emitter) {
        const mitsuba::Object *radiance = ParameterReader(emitter).object("radiance");
        auto [entry, added]             = m_images.try_emplace(radiance);
        if (added)
            entry->second = Image::read(radiance);
        return entry->second.get();
    }

private:
    std::unordered_map<const mitsuba::Object *, std::unique_ptr<Image>> m_images;
};

} // namespace manylights
