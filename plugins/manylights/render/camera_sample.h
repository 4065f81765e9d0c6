#pragma once

/// What a ray from the camera puts into the channels of a film.

#include "film_channels.h"
#include "film_color.h"
#include <mitsuba/render/film.h>
#include <mitsuba/render/sampler.h>
#include <mitsuba/render/sensor.h>

namespace manylights {

template <typename Float, typename Spectrum, typename Integrator> class CameraSample {
public:
    MI_IMPORT_TYPES(Scene, Sensor, Sampler, Film)

    CameraSample(const Integrator &integrator, const Scene *scene, const Sensor *sensor,
                 Sampler *sampler)
        : m_integrator(integrator), m_scene(scene), m_sensor(sensor),
          m_film(sensor->film()), m_sampler(sampler) {}

    /**
     * The film's channels, in the way of Mitsuba's integrators. Returns the place within the
     * pixel.
     * @param scale  of ray differentials
     */
    Vector2f render(const Vector2f &pixel, ScalarFloat scale, Float *values,
                    const Mask &active) const {
        ScalarVector2f inverse = 1.f / ScalarVector2f(m_film->crop_size()),
                       origin  = -ScalarVector2f(m_film->crop_offset()) * inverse;
        Vector2f offset        = m_sampler->next_2d(active),
                 position      = dr::fmadd(pixel + offset, inverse, origin);
        Point2f aperture(.5f);
        if (m_sensor->needs_aperture_sample())
            aperture = m_sampler->next_2d(active);
        Float time = m_sensor->shutter_open();
        if (m_sensor->shutter_open_time() > 0.f)
            time += m_sampler->next_1d(active) * m_sensor->shutter_open_time();
        Float wavelength = 0.f;
        if constexpr (mitsuba::is_spectral_v<Spectrum>)
            wavelength = m_sampler->next_1d(active);
        auto [ray, weight] =
            m_sensor->sample_ray_differential(time, wavelength, position, aperture);
        if (ray.has_differentials)
            ray.scale_differential(scale);

        auto [spectrum, valid] = m_integrator.sample_weighted(
            m_scene, m_sampler, ray, &weight, m_sensor->medium(),
            values + own_channels(m_film), active);
        write(values, mitsuba::unpolarized_spectrum(weight * spectrum), ray.wavelengths,
              valid, active);
        return offset;
    }

private:
    /// Into the channels of the film: special ones, or R, G, B, alpha if wanted and weight
    void write(Float *values, const UnpolarizedSpectrum &spectrum,
               const Wavelength &wavelengths, const Mask &valid,
               const Mask &active) const {
        Float alpha = dr::select(valid, Float(1.f), Float(0.f));
        if (has_flag(m_film->flags(), mitsuba::FilmFlags::Special)) {
            m_film->prepare_sample(spectrum, wavelengths, values, 1.f, alpha, valid);
            return;
        }
        Color3f rgb = film_color<Float, Spectrum>(spectrum, wavelengths, active);
        for (size_t i = 0; i < 3; ++i)
            values[i] = rgb.entry(i);
        size_t weight = own_channels(m_film) - 1;
        if (weight > 3)
            values[3] = alpha;
        values[weight] = 1.f;
    }

    const Integrator &m_integrator;
    const Scene *m_scene;
    const Sensor *m_sensor;
    const Film *m_film;
    Sampler *m_sampler;
};

} // namespace manylights
