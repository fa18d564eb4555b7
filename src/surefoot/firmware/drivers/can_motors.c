/* Template for motors with their own drives on a CAN bus. A drive receives position, speed, kp, kd and torque in one
 * frame of 8 bytes, and answers each with position, speed, torque, temperature and error. Many actuators modelled on
 * the MIT Mini Cheetah do so (the original answers with 6 bytes). The voltage is not in the frame: measure the
 * battery's.
 *
 * To adapt: set identifiers, ranges and zeros below from the manual of the drive, and the layout if its frames differ.
 * A bus with 1 Mbit/s supports four motors per millisecond: two frames of some 120 bits each. For more motors, use
 * several buses, or a longer servo_period in core/robot.h. Configure the drives to switch off if no frame arrives for
 * some 20 ms.
 *
 * The drives close the servo loop themselves, with the gains of core/robot.h and their own limits. */
#include <math.h>

#include "can_bus.h"
#include "drivers.h"
#include "hal.h"
#include "robot.h"

#if !ROBOT_EFFORT_IS_TORQUE
#error "the gains of this robot are duties of DC motors, and these drives take torques"
#endif

#define FIRST_ID 1u          /* identifier of motor 0; the others follow */
#define SWITCH_ON 0xFCu      /* command byte that switches a drive on */
#define SILENCE 10000u       /* us without an answer after which a motor counts as off */
#define MAX_ANGLE 12.5f      /* rad; frames hold -MAX to MAX */
#define MAX_SPEED 45.0f      /* rad/s */
#define MAX_TORQUE 24.0f     /* N m */
#define MAX_KP 500.0f        /* N m/rad; frames hold 0 to MAX */
#define MAX_KD 5.0f          /* N m s/rad */
#define TEMPERATURE_OFFSET 0 /* degC of byte value 0 */

/* Motor angle [rad] at which the drive reads 0, and direction: -1 if the drive turns the other way. */
static const float zero[SUREFOOT_MOTORS] = {0};
static const float direction[SUREFOOT_MOTORS] = {[0 ... SUREFOOT_MOTORS - 1] = 1.0f};

static struct {
    float angle, speed, torque, temperature;
    uint8_t error;
    bool heard;
    uint64_t time;
} seen[SUREFOOT_MOTORS];

/* Encode a number between low and high with a number of bits: rounded and clipped; NaN becomes 0. */
static uint32_t pack(float number, float low, float high, uint32_t bits)
{
    const uint32_t maximum = (1u << bits) - 1u;

    if (!(number >= low)) {
        number = number < low ? low : 0.0f;
    }
    number = number > high ? high : number;
    return (uint32_t)((number - low) / (high - low) * (float)maximum + 0.5f);
}

static float unpack(uint32_t number, float low, float high, uint32_t bits)
{
    return low + (high - low) * (float)number / (float)((1u << bits) - 1u);
}

/* Send a special frame to a drive: seven bytes FF and a command byte. Return whether there was room. */
static bool send_special(uint16_t motor, uint8_t command)
{
    const can_frame frame = {(uint16_t)(FIRST_ID + motor), 8, {0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, command}};

    return can_send(&frame);
}

static bool is_silent(int motor)
{
    return !seen[motor].heard || hal_time() - seen[motor].time > SILENCE;
}

static void take_answers(void)
{
    can_frame frame;

    while (can_receive(&frame)) {
        const uint8_t *const d = frame.data;
        const uint32_t motor = (uint32_t)d[0] - FIRST_ID;
        uint32_t p, v, t;

        /* The identifier of an answer is 0 (the master's) or the drive's own. */
        if (frame.length != 8u || motor >= SUREFOOT_MOTORS || (frame.id != 0u && frame.id != d[0])) {
            continue;
        }
        p = (uint32_t)d[1] << 8 | d[2];
        v = (uint32_t)d[3] << 4 | d[4] >> 4;
        t = (uint32_t)(d[4] & 15) << 8 | d[5];
        seen[motor].angle = zero[motor] + direction[motor] * unpack(p, -MAX_ANGLE, MAX_ANGLE, 16);
        seen[motor].speed = direction[motor] * unpack(v, -MAX_SPEED, MAX_SPEED, 12);
        seen[motor].torque = direction[motor] * unpack(t, -MAX_TORQUE, MAX_TORQUE, 12);
        seen[motor].temperature = (float)(d[6] + TEMPERATURE_OFFSET);
        seen[motor].error = d[7];
        seen[motor].heard = true;
        seen[motor].time = hal_time();
    }
}

void start_motors(void)
{
    can_start();
}

void hal_enable_motors(void)
{
    /* hal_drive_motors switches silent drives on, and at first all are silent. */
}

void hal_read_motors(float angle[SUREFOOT_MOTORS], float speed[SUREFOOT_MOTORS], float torque[SUREFOOT_MOTORS])
{
    int m;

    take_answers();
    for (m = 0; m < SUREFOOT_MOTORS; m++) {
        angle[m] = seen[m].heard ? seen[m].angle : NAN;
        speed[m] = seen[m].heard ? seen[m].speed : NAN;
        torque[m] = seen[m].torque;
    }
}

void hal_read_temperatures(float temperature[SUREFOOT_MOTORS])
{
    int m;

    for (m = 0; m < SUREFOOT_MOTORS; m++) {
        temperature[m] = seen[m].heard ? seen[m].temperature : NAN;
    }
}

void hal_drive_motors(const motor_command command[SUREFOOT_MOTORS])
{
    uint16_t m;

    can_clear(); /* frames not sent within a servo period are outdated: a bus that recovers must not send them */
    for (m = 0; m < SUREFOOT_MOTORS; m++) {
        const float angle = direction[m] * (command[m].target - zero[m]);
        const uint32_t p = pack(angle, -MAX_ANGLE, MAX_ANGLE, 16), v = pack(0.0f, -MAX_SPEED, MAX_SPEED, 12);
        const uint32_t kp = pack(isnan(angle) ? 0.0f : command[m].kp, 0.0f, MAX_KP, 12);
        const uint32_t kd = pack(command[m].kd, 0.0f, MAX_KD, 12);
        const uint32_t t = pack(direction[m] * command[m].feedforward, -MAX_TORQUE, MAX_TORQUE, 12);
        const can_frame frame = {
            (uint16_t)(FIRST_ID + m),
            8,
            {(uint8_t)(p >> 8), (uint8_t)p, (uint8_t)(v >> 4), (uint8_t)((v & 15u) << 4 | kp >> 8), (uint8_t)kp,
             (uint8_t)(kd >> 4), (uint8_t)((kd & 15u) << 4 | t >> 8), (uint8_t)t},
        };

        /* A drive that had no power is off. The command follows, in case only the answers of the drive are lost. */
        if (!is_silent(m) || send_special(m, SWITCH_ON)) {
            (void)can_send(&frame); /* lost if there is no room; a newer one follows */
        }
    }
}

uint8_t hal_hazard(const char **text)
{
    static char silent[] = "the drive of motor 00 does not answer", wrong[] = "the drive of motor 00 reports an error";
    int m;

    for (m = 0; m < SUREFOOT_MOTORS; m++) {
        char *const fault = is_silent(m) ? silent : wrong;

        if (fault == silent || seen[m].error != 0u) {
            fault[19] = (char)('0' + m / 10);
            fault[20] = (char)('0' + m % 10);
            *text = fault;
            return SUREFOOT_REASON_MOTOR_OFF;
        }
    }
    return SUREFOOT_REASON_NONE;
}
