/* The board's program on an STM32F405 in QEMU, driven by events of surefoot's emulator. They use the standard input and
 * output of QEMU, since its serial line takes some 40 us per byte. */
#include "events.h"
#include "registers.h"
#include "semihosting.h"

bool read_event(void *bytes, size_t size)
{
    return read_host(bytes, size);
}

void write_answer(const void *bytes, size_t size)
{
    write_host(bytes, size);
}

uint32_t read_cycles(void)
{
    return 0xFFFFFFu - SYST_CVR;
}

void tick_interrupt(void)
{
}

void line_interrupt(void)
{
}

int main(void)
{
    SYST_RVR = 0xFFFFFFu;
    SYST_CVR = 0;
    SYST_CSR = 5; /* no interrupt */
    open_host();
    run_events();
    end_host();
    return 0;
}
